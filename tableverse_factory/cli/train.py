"""`tableverse train`: training of networks on synthetic scenes."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from tableverse_factory.cli.options import require_local_path

if TYPE_CHECKING:
    from tableverse_factory.evaluation.training.train import TrainProgress
    from tableverse_factory.models.local.device import Device

train = typer.Typer(name="train", help="Train networks on synthetic scenes.", no_args_is_help=True)

TrainFolder = Annotated[
    Path, typer.Argument(metavar="DIR", callback=require_local_path, help="New folder, or one to continue.")
]
TrainSteps = Annotated[int, typer.Option(min=1, max=10_000_000, help="Steps, of --batch views each.")]
TrainBatch = Annotated[int, typer.Option(min=1, max=1024, help="Views per step.")]
TrainSeed = Annotated[int, typer.Option(min=0, max=2**32 - 1, help="Seed of scenes, order and first weights.")]
TrainDevice = Annotated[Literal["auto", "cpu", "cuda"], typer.Option(help="Device to train on.")]
TrainJobs = Annotated[
    int | None, typer.Option("--jobs", "-j", min=0, help="Processes that make views; one per CPU by default.")
]


@train.command("segmenter")
def train_segmenter(
    folder: TrainFolder,
    scenes: Annotated[int, typer.Option("--scenes", "-n", min=1, max=1_000_000, help="Training scenes.")] = 2000,
    steps: TrainSteps = 20_000,
    batch: TrainBatch = 16,
    seed: TrainSeed = 0,
    device: TrainDevice = "auto",
    jobs: TrainJobs = None,
) -> None:
    """Train the network of the detector `learned` on depth images of synthetic scenes.

    Writes DIR/views (six images of each scene), DIR/checkpoint.safetensors and DIR/segmenter.onnx. The same command
    again continues from the checkpoint.

    Example: `tableverse train segmenter net --scenes 240 --steps 800 --batch 4 --device cpu`
    """
    from tableverse_factory.cli.progress_bar import count_progress
    from tableverse_factory.core.process_pool import count_available_cpus
    from tableverse_factory.evaluation.training.onnx_file import write_onnx
    from tableverse_factory.evaluation.training.train import TrainSettings, train_network
    from tableverse_factory.evaluation.training.views import make_views

    where = _prepare_training(device)
    processes = count_available_cpus() if jobs is None else jobs
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


@train.command("picture")
def train_picture(
    folder: TrainFolder,
    steps: TrainSteps = 7_900,
    minutes: Annotated[
        float | None, typer.Option(min=0.1, help="Stop with a checkpoint after so many; the command again continues.")
    ] = None,
    batch: TrainBatch = 64,
    views: Annotated[
        int, typer.Option(min=64, max=1_000_000, help="Views that are kept to draw from, 1.3 MB of the GPU each.")
    ] = 24_000,
    scenes: Annotated[
        int, typer.Option("--scenes", "-n", min=1, max=3_000, help="Settled scenes whose meshes are used.")
    ] = 1_200,
    seed: TrainSeed = 0,
    start: Annotated[
        Path | None,
        typer.Option("--from", dir_okay=False, help="Start from the weights.safetensors of another training."),
    ] = None,
    device: TrainDevice = "auto",
    jobs: TrainJobs = None,
) -> None:
    """Train the network of pictures, with a sensor's depth and without, on views that a GPU renders beside it.

    Writes DIR/meshes_SCENES_SEED.npz, DIR/checkpoint.safetensors, DIR/weights.safetensors and DIR/picture.onnx. The
    same command again continues from the checkpoint. On a CPU views are lit plainly, for trials.

    Example: `tableverse train picture net --minutes 10`
    """
    import math

    from tableverse_factory.core.optional_imports import import_extra
    from tableverse_factory.core.process_pool import count_available_cpus

    where = _prepare_training(device).kind
    if where == "cuda":
        import_extra("cupy", "rendering on a GPU", "training")
    from tableverse_factory.evaluation.training.picture.settings import PictureSettings  # these import torch
    from tableverse_factory.evaluation.training.picture.export import export_network
    from tableverse_factory.evaluation.training.picture.train import TrainRun, train_pictures

    processes = count_available_cpus() if jobs is None else jobs
    settings = PictureSettings(steps, scenes, seed, batch, capacity=views, first=min(views, 2_000))
    pool = _provide_pool(folder, scenes, seed, processes)
    run = TrainRun(folder, pool, where, processes, math.inf if minutes is None else minutes, start=start)
    done = train_pictures(settings, run, lambda line: print(line, file=sys.stderr, flush=True))
    path = folder / "picture.onnx"
    difference = export_network(folder, path)
    print(f"{path}: {path.stat().st_size / 1e6:.1f} MB, within {difference:.0e} of the net in torch")
    print(f"{done} of {steps} steps" + ("" if done >= steps else "; the same command continues"))


def _provide_pool(folder: Path, scenes: int, seed: int, jobs: int) -> Path:
    """Settle the scenes whose meshes are used, unless an earlier command did, and return their file."""
    from tableverse_factory.cli.progress_bar import count_progress
    from tableverse_factory.evaluation.training.picture.pool import make_pool

    path = folder / f"meshes_{scenes}_{seed}.npz"
    folder.mkdir(parents=True, exist_ok=True)
    if not path.is_file():
        with count_progress("scenes", scenes) as made:
            make_pool(scenes, seed + 1, made, jobs).write(path)  # + 1: so was the network of the package trained
    return path


def _prepare_training(device: Literal["auto", "cpu", "cuda"]) -> "Device":
    """Choose the device, and fail before any work if a package is missing."""
    from schemas.config import ModelsConfig
    from tableverse_factory.core.optional_imports import import_extra
    from tableverse_factory.models.local.device import select_device

    for module in ("torch", "safetensors", "onnx", "onnxruntime"):
        import_extra(module, "training", "models")
    return select_device(ModelsConfig(device=device, precision="float32"), "--device")
