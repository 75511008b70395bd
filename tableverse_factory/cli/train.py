"""`tableverse train`: nets that are made from nothing but our own synthetic scenes."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from tableverse_factory.cli.options import on_this_machine

if TYPE_CHECKING:
    from tableverse_factory.evaluation.training.train import TrainProgress

train = typer.Typer(name="train", help="Train nets on synthetic scenes of your own.", no_args_is_help=True)


@train.command("segmenter")
def train_segmenter(
    folder: Annotated[
        Path,
        typer.Argument(metavar="DIR", callback=on_this_machine, help="A new folder, or one to go on with."),
    ],
    scenes: Annotated[int, typer.Option("--scenes", "-n", min=1, max=1_000_000, help="To learn from.")] = 2000,
    steps: Annotated[int, typer.Option(min=1, max=10_000_000, help="Of --batch views each.")] = 20_000,
    batch: Annotated[int, typer.Option(min=1, max=1024, help="Views per step.")] = 16,
    seed: Annotated[int, typer.Option(min=0, help="Same seed, same scenes, order and first weights.")] = 0,
    device: Annotated[Literal["auto", "cpu", "cuda"], typer.Option(help="Where it is trained.")] = "auto",
    jobs: Annotated[
        int | None,
        typer.Option("--jobs", "-j", min=0, help="Processes that make and vary views; one per CPU by default."),
    ] = None,
) -> None:
    """Train the net of the detector `learned` on depth images of synthetic scenes.

    DIR/views holds the images, six of each scene; DIR/checkpoint.safetensors where it stands, DIR/segmenter.onnx what
    came out. The same command again goes on where it stopped.

    Example: `tableverse train segmenter net --scenes 240 --steps 800 --batch 4 --device cpu`
    """
    from schemas.config import ModelsConfig
    from tableverse_factory.cli.progress_bar import counter
    from tableverse_factory.core.optional_imports import require_extra
    from tableverse_factory.core.process_pool import available_cpus
    from tableverse_factory.evaluation.training.onnx_file import write_onnx
    from tableverse_factory.evaluation.training.train import Settings, train
    from tableverse_factory.evaluation.training.views import make_views
    from tableverse_factory.models.local.device import device_of

    for module in ("torch", "safetensors", "onnx", "onnxruntime"):
        require_extra(module, "training", "models")  # before anything is made that could not be used
    processes = available_cpus() if jobs is None else jobs
    where = device_of(ModelsConfig(device=device, precision="float32"))
    with counter("scenes", scenes) as made:
        views = make_views(folder / "views", scenes, seed, made, processes)
    recent: list[TrainProgress] = []
    with counter("steps", steps) as done:

        def on_step(progress: "TrainProgress") -> None:
            recent[:] = [*recent[-99:], progress]
            done.at(progress.step, steps)

        network = train(views, folder, Settings(scenes, steps, seed, batch), where, on_step, jobs=processes)
    path = folder / "segmenter.onnx"
    difference = write_onnx(network, path)
    if recent:
        offset_mm = 1e3 * sum(step.offset_m for step in recent) / len(recent)
        entropy = sum(step.objects for step in recent) / len(recent)
        print(
            f"last {len(recent)} steps: centres off by {offset_mm:.1f} mm, cross entropy of thing or not {entropy:.3f}"
        )
    print(f"{path}: {path.stat().st_size / 1e6:.1f} MB, within {difference:.0e} of the net in torch")
