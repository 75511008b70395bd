"""`tableverse train`: training of the network of pictures on synthetic scenes, and of policies on a dataset."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from tableverse_factory.cli.options import require_local_path
from tableverse_factory.core.text import sanitize_line

if TYPE_CHECKING:
    from tableverse_factory.models.local.device import Device

train = typer.Typer(
    name="train",
    help="Train the network of pictures, and policies on a dataset.",
    no_args_is_help=True,
)


def _require_folder(path: Path) -> Path:
    """Refuse a file, and what would lie within one."""
    require_local_path(path)
    if found := next((each for each in (path, *path.parents) if each.exists() and not each.is_dir()), None):
        shown = sanitize_line(str(found), 300)
        raise typer.BadParameter(f"{shown} is a file: give a new folder, or one whose training goes on")
    return path


TrainFolder = Annotated[
    Path, typer.Argument(metavar="DIR", callback=_require_folder, help="New folder, or one to continue.")
]
TrainSeed = Annotated[int, typer.Option(min=0, max=2**32 - 1, help="Seed of what is drawn, and of the first weights.")]
TrainDevice = Annotated[Literal["auto", "cpu", "cuda"], typer.Option(help="Device to train on.")]
TrainMinutes = Annotated[
    float | None, typer.Option(min=0.1, help="Stop with a checkpoint after so many; the command again continues.")
]
_PICTURES_FROM = "Train goals on pictures instead; motions are those of these weights, of a policy on states."


@train.command("picture")
def train_picture(
    folder: TrainFolder,
    steps: Annotated[int, typer.Option(min=1, max=10_000_000, help="Steps of the training.")] = 7_900,
    minutes: TrainMinutes = None,
    batch: Annotated[int, typer.Option(min=1, max=1024, help="Views per step.")] = 64,
    views: Annotated[
        int, typer.Option(min=64, max=1_000_000, help="Views that are kept to draw from, 1.3 MB of the GPU each.")
    ] = 24_000,
    scenes: Annotated[
        int, typer.Option("--scenes", "-n", min=1, max=3_000, help="Settled scenes whose meshes are used.")
    ] = 1_200,
    seed: TrainSeed = 0,
    start: Annotated[
        Path | None,
        typer.Option("--from", dir_okay=False, help="Start from weights.safetensors or picture.onnx of another."),
    ] = None,
    gpus: Annotated[
        int | None, typer.Option(min=1, max=64, help="GPUs to train on, each with a batch of its own; all without.")
    ] = None,
    device: TrainDevice = "auto",
    jobs: Annotated[
        int | None, typer.Option("--jobs", "-j", min=0, help="Processes that make views; one per CPU by default.")
    ] = None,
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
    import_extra("onnx", "training", "training")
    if where == "cuda":
        import_extra("cupy", "rendering on a GPU", "training")
    from tableverse_factory.evaluation.training.picture.export import export_network
    from tableverse_factory.evaluation.training.picture.settings import PictureSettings  # these import torch
    from tableverse_factory.evaluation.training.picture.train import TrainRun, train_pictures

    processes = count_available_cpus() if jobs is None else jobs
    ranks = _choose_gpus(where, gpus)
    settings = PictureSettings(steps, scenes, seed, batch, capacity=views, first=min(views, 2_000), gpus=ranks)
    pool = _provide_pool(folder, scenes, seed, processes)
    own = -(-processes // ranks)
    run = TrainRun(folder, pool, where, own, math.inf if minutes is None else minutes, start=start)
    done = train_pictures(settings, run, lambda line: print(line, file=sys.stderr, flush=True))
    path = folder / "picture.onnx"
    difference = export_network(folder, path)
    print(f"{path}: {path.stat().st_size / 1e6:.1f} MB, within {difference:.0e} of the net in torch")
    print(f"{done} of {steps} steps" + ("" if done >= steps else "; the same command continues"))


def _choose_gpus(device: str, wanted: int | None) -> int:
    """Choose the number of training processes: the one that is wanted, else one per GPU."""
    import torch

    from tableverse_factory.core.errors import InputError

    seen = torch.cuda.device_count() if device == "cuda" else 1
    if device == "cuda" and wanted is not None and wanted > seen:
        raise InputError(f"--gpus {wanted}: torch sees {seen}")
    return seen if wanted is None else wanted


@train.command("policy")
def train_policy(
    folder: TrainFolder,
    datasets: Annotated[
        list[str] | None,
        typer.Option("--dataset", metavar="OUT", help="Dataset with trajectories, read the first time; may repeat."),
    ] = None,
    steps: Annotated[
        int | None, typer.Option(min=1, max=10_000_000, help="Steps; by default 3,000 on states, 8,000 on pictures.")
    ] = None,
    minutes: TrainMinutes = None,
    goals: Annotated[int, typer.Option(min=1, max=65_536, help="Goals per step.")] = 128,
    chunks: Annotated[
        int | None, typer.Option(min=1, max=65_536, help="Chunks of motion per step, on states; by default 512.")
    ] = None,
    views: Annotated[
        int | None, typer.Option(min=1, max=65_536, help="Views per step, on pictures; by default 64.")
    ] = None,
    scenes: Annotated[int | None, typer.Option(min=1, help="Number of scenes to learn from; all without.")] = None,
    motions: Annotated[
        int | None, typer.Option(min=1, help="Number of motions to learn, from these scenes in turn; all without.")
    ] = None,
    state: Annotated[
        Path | None,
        typer.Option("--pictures-from", metavar="WEIGHTS", dir_okay=False, exists=True, help=_PICTURES_FROM),
    ] = None,
    tables: Annotated[
        int | None, typer.Option(min=0, max=50_000, help="Synthetic tables that pictures show too; 2,000 by default.")
    ] = None,
    robot: Annotated[str, typer.Option(metavar="ARM", help="The arm whose motions are packed.")] = "panda",
    seed: TrainSeed = 0,
    device: TrainDevice = "auto",
) -> None:
    """Train a policy on states, or one on pictures, from the successful motions of the splits train and validation.

    Writes DIR/demonstrations.npz (the motions, packed), DIR/checkpoint.safetensors and DIR/weights.safetensors, with
    which `tableverse benchmark run` plays it; with --pictures-from also DIR/pictures.npz. What is packed already is not
    read from the dataset again. The same command again continues from the checkpoint.

    Example: `tableverse train policy net --dataset out --minutes 10`
    """
    import math

    from tableverse_factory.core.errors import ConfigError

    where = _prepare_training(device).kind
    from tableverse_factory.evaluation.training.policy.settings import PolicySettings
    from tableverse_factory.evaluation.training.policy.train import (
        TrainRun,
        load_teacher,
        train_picture_policy,
        train_state_policy,
    )

    def say(line: str) -> None:
        print(line, file=sys.stderr, flush=True)

    if state is None and not (tables is None and views is None):
        raise ConfigError("--tables and --views are for a policy on pictures: give --pictures-from too")
    if state is not None and chunks is not None:
        raise ConfigError("--chunks is for a policy on states: one on pictures takes its motions from --pictures-from")
    steps = steps or (3_000 if state is None else 8_000)
    given = {name: value for name, value in (("chunks", chunks), ("views", views)) if value is not None}
    settings = PolicySettings(steps, seed, goals, scenes=scenes, motions=motions, **given)
    if state is not None:
        load_teacher(settings, state)  # what is refused is, before hours of packing
    demonstrations = _provide_packed(folder / "demonstrations.npz", datasets or [], robot)
    run = TrainRun(folder, demonstrations, where, math.inf if minutes is None else minutes)
    if state is None:
        done = train_state_policy(settings, run, say)
    else:
        pictures = _provide_pictures(folder / "pictures.npz", datasets or [], robot, tables)
        done = train_picture_policy(settings, run, pictures, state, say)
    print(f"{done} of {steps} steps" + ("" if done >= steps else "; the same command continues"))
    print(f"{folder / 'weights.safetensors'}: give it to `tableverse benchmark run --weights`")


def _provide_packed(path: Path, datasets: list[str], robot: str) -> Path:
    """Pack the datasets' motions, unless an earlier command did, and return their file."""
    from tableverse_factory.cli.progress_bar import count_progress
    from tableverse_factory.dataset.dataset import open_dataset
    from tableverse_factory.evaluation.training.policy.pack import pack_demonstrations

    if not _is_packed(path, datasets):
        with count_progress("scenes") as done:
            pack_demonstrations([*map(open_dataset, datasets)], robot=robot, on_scene=done.update).write(path)
    return path


def _provide_pictures(path: Path, datasets: list[str], robot: str, tables: int | None) -> Path:
    """Pack pictures of the datasets' scenes and of synthetic tables, unless an earlier command did."""
    from tableverse_factory.cli.progress_bar import count_progress
    from tableverse_factory.core.process_pool import count_available_cpus
    from tableverse_factory.dataset.dataset import open_dataset
    from tableverse_factory.evaluation.training.policy.pack_pictures import pack_pictures
    from tableverse_factory.evaluation.training.policy.synthetic_views import TABLES

    if _is_packed(path, datasets):
        if tables is not None:
            print(f"{path} is there already: no table is drawn for --tables", file=sys.stderr, flush=True)
        return path
    opened, wanted = [*map(open_dataset, datasets)], TABLES if tables is None else tables
    with count_progress("scenes and tables") as done:
        jobs = count_available_cpus()
        pack_pictures(opened, robot=robot, on_scene=done.update, jobs=jobs, tables=wanted).write(path)
    return path


def _is_packed(path: Path, datasets: list[str]) -> bool:
    """Tell whether a file was packed by an earlier command; ConfigError if it has yet to be, and nothing is given."""
    from tableverse_factory.core.errors import ConfigError

    if path.is_file():
        if datasets:
            print(f"{path} is there already: --dataset is not read", file=sys.stderr, flush=True)
        return True
    if not datasets:
        raise ConfigError(f"{path} is not there: give --dataset, whose motions are packed into it")
    path.parent.mkdir(parents=True, exist_ok=True)
    return False


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

    for module in ("torch", "safetensors"):
        import_extra(module, "training", "models")
    return select_device(ModelsConfig(device=device, precision="float32"), "--device")
