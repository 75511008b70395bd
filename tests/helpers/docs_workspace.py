"""A folder in which a page of the documentation is read: what its commands speak of lies there.

`my_captures/`, `my_pictures/` and `captures/` (one synthetic capture), `photos/` with one picture, `images.parquet` of
the first, `layouts/` with its `truth/`, `meshes/`, `recording/` as Open3D unpacks one, and `out`: the dataset as the
first command of the page that builds it would leave it, so that building it finds nothing left to do. It is not there
where a page makes its manifest from something else. `SCENE_ID` is the id of a scene of `out`. A page that types nothing
but how to install us finds `out` alone, a dataset of one scene of blocks: any will do.
"""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import skimage.data

from tableverse_factory import open_dataset
from tests.helpers.docs_pages import Command
from tests.helpers.learnable_dataset import write_learnable_dataset
from tests.helpers.paths import ROOT

SCENES = 1
QUICKER = (
    (r"tableverse (build|trajectories) (?!.*--executor)", "--executor local"),  # Ray: ten seconds; tests/ray has it
    (r"tableverse (build|trajectories) ", "--set trajectories.max_tasks=1"),
    (r"tableverse synth ", f"--scenes {SCENES}"),
    (r"tableverse report ", "--films 1"),
)
"""Options that are added to what a page says, so that reading it takes seconds; none changes what is shown."""

QUICK = ("--executor", "local", "--set", "trajectories.max_tasks=1")
OWN_CAPTURES = "my_captures"
_BUILDS = re.compile(r"tableverse (?:build images\.parquet|trajectories) out\b")
_MANIFEST = re.compile(r"tableverse manifest (\S+)")


@dataclass(frozen=True)
class Answer:
    """How a command ended."""

    code: int
    out: str
    err: str


class Room:
    """Commands typed one after another, with one shell's variables and folder."""

    def __init__(self, prepared: Path, folder: Path, page: Sequence[Command]) -> None:
        """Lays out a fresh `folder` for a page with these commands."""
        if folder.exists():
            shutil.rmtree(folder)
        plain = folder / "out"
        if only_installs(page):
            folder.mkdir(parents=True)
            write_learnable_dataset(plain, scenes=1, moved=0)
        else:
            lay_out(page, prepared, folder)
            plain = prepared / "plain"
        (folder / "deploy").symlink_to(ROOT / "deploy")
        self.folder = folder
        self._state = folder.parent / "shell-state"
        self._state.write_text(f"cd {folder}\n")
        self.scene_id = first_scene(plain)

    def type(self, command: Command) -> Answer:
        """Runs what a page says, in bash."""
        script = f'. "{self._state}"\n{self.as_typed(command)}\ncode=$?\n'
        script += f'{{ export -p; printf "cd %q\\n" "$PWD"; }} > "{self._state}"\nexit $code'
        done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, env=environment(self.folder))
        return Answer(done.returncode, done.stdout, done.stderr)

    def enter(self) -> None:
        """Goes where the shell is: Python on a page is run there."""
        place = shlex.split(self._state.read_text().splitlines()[-1])[1]
        os.chdir(place)

    def as_typed(self, command: Command) -> str:
        """With its placeholder filled in, and quick."""
        text = self.filled(command.text)
        for pattern, added in QUICKER:
            text = re.sub(rf"^{pattern}", lambda match, added=added: f"{match[0]}{added} ", text)
        return text

    def filled(self, text: str) -> str:
        """With a scene's id for `SCENE_ID`."""
        return text.replace("SCENE_ID", self.scene_id)


def environment(folder: Path) -> dict[str, str]:
    """That of a user who has activated the virtual environment."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    return {**os.environ, "PATH": path, "TABLEVERSE_CACHE": str(folder.parent / "cache"), "COLUMNS": "100"}


def lay_out(page: Sequence[Command], prepared: Path, folder: Path) -> None:
    """Copies what a page that types our commands finds; the first such page makes it."""
    if not (prepared / "plain").exists():
        shutil.rmtree(prepared, ignore_errors=True)  # what a preparation that failed has left
        prepare(prepared, folder)
        shutil.rmtree(folder)
    shutil.copytree(prepared / "common", folder)
    if kind := kind_of_dataset(page):
        shutil.copytree(dataset_of(kind, prepared, folder), folder / "out")


def only_installs(page: Sequence[Command]) -> bool:
    """Whether a page types commands, and none of ours."""
    return bool(page) and not any(command.text.startswith("tableverse ") for command in page)


def prepare(prepared: Path, folder: Path) -> None:
    """Makes what every page finds: real captures, built for real, in the place where pages are read."""
    common = prepared / "common"
    common.mkdir(parents=True)

    run(folder, common, "synth", OWN_CAPTURES, "--scenes", SCENES, "--seed", 7)
    for name in ("my_pictures", "captures"):
        shutil.copytree(common / OWN_CAPTURES, common / name)
    (common / "photos").mkdir()
    shutil.copy(Path(skimage.data.data_dir) / "coffee.png", common / "photos")
    run(folder, common, "synth", ".synth", "--kind", "layouts", "--scenes", SCENES, "--seed", 7)
    for name in ("layouts", "meshes"):
        shutil.move(common / ".synth" / name, common / name)
    shutil.move(common / ".synth" / "truth", common / "layouts" / "truth")
    shutil.rmtree(common / ".synth")
    write_recording(common / OWN_CAPTURES / "synth_000000", common / "recording")
    shutil.copytree(common, folder)  # the manifest holds absolute paths: it is made where it is read
    run(folder, folder, "manifest", OWN_CAPTURES, "--out", "images.parquet")
    shutil.copy(folder / "images.parquet", common)
    run(folder, folder, "build", "images.parquet", "out", *QUICK)
    shutil.copytree(folder / "out", prepared / "plain")


def dataset_of(kind: str, prepared: Path, folder: Path) -> Path:
    """Where this kind lies; trajectories are made when a page first needs them."""
    if not (prepared / kind).exists():
        shutil.copytree(prepared / "plain", folder / "out")
        run(folder, folder, "trajectories", "out", *QUICK[:2])
        shutil.move(folder / "out", prepared / kind)
    return prepared / kind


def run(folder: Path, where: Path, *arguments: object) -> None:
    """A command that must succeed."""
    line = ["tableverse", *map(str, arguments)]
    done = subprocess.run(line, cwd=where, env=environment(folder), capture_output=True, text=True)
    assert done.returncode == 0, f"{line}: {done.stderr}"


def write_recording(capture: Path, recording: Path) -> None:
    """One frame, in the layout in which Open3D unpacks recordings of depth cameras."""
    camera = json.loads((capture / "camera.json").read_text())
    for name, source in (("color/00000.png", "color.png"), ("depth/00000.png", "depth.png")):
        (recording / name).parent.mkdir(parents=True)
        shutil.copy(capture / source, recording / name)
    matrix = [camera["fx"], 0, 0, 0, camera["fy"], 0, camera["cx"], camera["cy"], 1]
    about = {"intrinsic_matrix": matrix, "depth_scale": 1 / camera["depth_scale"]}
    (recording / "intrinsic.json").write_text(json.dumps(about))


def kind_of_dataset(page: Sequence[Command]) -> str | None:
    """Which dataset a page that types our commands, or none at all, begins with."""
    texts = [command.text for command in page]
    sources = [match[1].strip("/") for match in map(_MANIFEST.match, texts) if match]
    if any(source != OWN_CAPTURES and "://" not in source for source in sources):
        return None
    first = next((text for text in texts if _BUILDS.match(text)), None)
    return "with_trajectories" if first is None or "+trajectories" in first else "plain"


def first_scene(out: Path) -> str:
    """The id of a scene that is done."""
    return str(open_dataset(out).objects.to_table(columns=["scene_id"])["scene_id"][0].as_py())
