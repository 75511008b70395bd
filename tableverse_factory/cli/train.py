"""`tableverse train`: training of networks on synthetic scenes."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from tableverse_factory.cli.options import require_local_path

if TYPE_CHECKING:
    from tableverse_factory.evaluation.training.train import TrainProgress

train = typer.Typer(name="train", help="Train networks on synthetic scenes.", no_args_is_help=True)


@train.command("segmenter")
def train_segmenter(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", callback=require_local_path, help="New folder, or one to continue.")
    ],
    scenes: Annotated[int, typer.Option("--scenes", "-n", min=1, max=1_000_000, help="Training scenes.")] = 2000,
    steps: Annotated[int, typer.Option(min=1, max=10_000_000, help="Steps, of --batch views each.")] = 20_000,
    batch: Annotated[int, typer.Option(min=1, max=1024, help="Views per step.")] = 16,
    seed: Annotated[int, typer.Option(min=0, help="Seed of scenes, order and first weights.")] = 0,
    device: Annotated[Literal["auto", "cpu", "cuda"], typer.Option(help="Device to train on.")] = "auto",
    jobs: Annotated[
        int | None,
        typer.Option("--jobs", "-j", min=0, help="Processes that make and augment views; one per CPU by default."),
    ] = None,
) -> None:
    """Train the network of the detector `learned` on depth images of synthetic scenes.

    Writes DIR/views (six images of each scene), DIR/checkpoint.safetensors and DIR/segmenter.onnx. The same command
    again continues from the checkpoint.

    Example: `tableverse train segmenter net --scenes 240 --steps 800 --batch 4 --device cpu`
    """
    from schemas.config import ModelsConfig
    from tableverse_factory.cli.progress_bar import count_progress
    from tableverse_factory.core.optional_imports import import_extra
    from tableverse_factory.core.process_pool import count_available_cpus
    from tableverse_factory.evaluation.training.onnx_file import write_onnx
    from tableverse_factory.evaluation.training.train import TrainSettings, train_network
    from tableverse_factory.evaluation.training.views import make_views
    from tableverse_factory.models.local.device import select_device

    for module in ("torch", "safetensors", "onnx", "onnxruntime"):
        import_extra(module, "training", "models")  # fail before any work
    processes = count_available_cpus() if jobs is None else jobs
    where = select_device(ModelsConfig(device=device, precision="float32"))
    with count_progress("scenes", scenes) as made:
        views = make_views(folder / "views", scenes, seed, made, processes)
    recent: list[TrainProgress] = []
    with count_progress("steps", steps) as done:

        def on_step(progress: "TrainProgress") -> None:
            recent[:] = [*recent[-99:], progress]
            done.update(progress.step, steps)

        network = train_network(
            views, folder, TrainSettings(scenes, steps, seed, batch), where, on_step, jobs=processes
        )
    path = folder / "segmenter.onnx"
    difference = write_onnx(network, path)
    if recent:
        offset_mm = 1e3 * sum(step.offset_m for step in recent) / len(recent)
        entropy = sum(step.objects for step in recent) / len(recent)
        print(
            f"last {len(recent)} steps: centres off by {offset_mm:.1f} mm, cross entropy of thing or not {entropy:.3f}"
        )
    print(f"{path}: {path.stat().st_size / 1e6:.1f} MB, within {difference:.0e} of the net in torch")
