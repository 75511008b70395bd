"""The wheel: what is in it, and that it runs where nothing of the checkout is in reach."""

import email
import hashlib
import json
import os
import re
import subprocess
import sys
import sysconfig
import venv
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from tableverse_factory.core.version import __version__
from tests.helpers.paths import ROOT

PACKAGES = ("schemas", "tableverse_factory", "workers")
BUILD = "import sys, hatchling.build; hatchling.build.build_wheel(sys.argv[1])"
"""What `make build` has pip do, without pip's own environment, for which an index would be asked."""
MAKE = """
import gymnasium
try:
    gymnasium.make("tableverse_factory.gym:TableVerse/PickPlace-v0", dataset="out")
except Exception as error:
    print(error)
"""
"""Asks for a dataset's environment by its name alone; this dataset has no motions."""
SUFFIXES = (
    ".py",
    ".typed",
    ".html",
    ".css",
    ".js",
    ".svg",
    ".json",
    ".yaml",
    ".onnx",
    ".safetensors",
    ".sha256",
    ".cu",
)
ELSEWHERE = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("dist")
    subprocess.run([sys.executable, "-c", BUILD, str(folder)], cwd=ROOT, check=True, capture_output=True)
    (path,) = folder.iterdir()
    return path


@pytest.fixture(scope="module")
def names(wheel) -> set[str]:
    return set(zipfile.ZipFile(wheel).namelist())


@pytest.fixture(scope="module")
def tableverse(wheel, tmp_path_factory) -> Path:
    """The command, installed from the wheel into an environment that has its dependencies and nothing else of us.

    The dependencies are those of this environment, by their folders; what leads to the checkout is left behind.
    """
    folder = tmp_path_factory.mktemp("environment")
    venv.create(folder)
    python = folder / "bin" / "python"
    site = next(folder.glob("lib/python*/site-packages"))
    install = ["install", "--quiet", "--disable-pip-version-check", "--no-index", "--no-deps", str(wheel)]
    subprocess.run([sys.executable, "-m", "pip", "--python", str(python), *install], check=True)
    needed = [path for path in sys.path if path.startswith(sysconfig.get_path("purelib"))]
    (site / "dependencies.pth").write_text("\n".join(needed))
    return folder / "bin" / "tableverse"


def run(command: Path, *arguments: object, folder: Path) -> str:
    ended = subprocess.run([command, *map(str, arguments)], cwd=folder, env=ELSEWHERE, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr[-2000:]
    return ended.stdout


def tracked() -> Iterator[str]:
    """What is in the repository of the packages; a copy without history has everything but what tools left."""
    for package in PACKAGES:
        for path in (ROOT / package).rglob("*"):
            if path.is_file() and path.suffix in SUFFIXES:
                yield str(path.relative_to(ROOT))


def test_it_holds_all_of_the_packages_and_nothing_else(names):
    assert set(tracked()) <= names
    rest = {name for name in names if not name.startswith(PACKAGES) and ".dist-info/" not in name}
    assert not rest
    assert not [name for name in names if "test" in Path(name).name or "__pycache__" in name]
    for name in (
        *(f"{package}/py.typed" for package in PACKAGES),
        "tableverse_factory/viz/gallery/templates/base.html",
    ):
        assert name in names
    assert any(name.endswith(".dist-info/licenses/LICENSE") for name in names)


WEIGHTS = [
    "models/picture/picture.onnx",
    *(f"evaluation/training/policy/{name}.safetensors" for name in ("picture", "state")),
]


@pytest.mark.parametrize("weights", WEIGHTS)
def test_it_holds_weights_undamaged(wheel, weights):
    path = f"tableverse_factory/{weights}"
    with zipfile.ZipFile(wheel) as archive:
        data, digest = archive.read(path), archive.read(f"{path.rpartition('.')[0]}.sha256")
    assert hashlib.sha256(data).hexdigest() == digest.decode().strip()


def test_it_says_what_it_is(wheel):
    """The version from its one place; the terms; what it needs, none of it by a path."""
    with zipfile.ZipFile(wheel) as archive:
        (path,) = [name for name in archive.namelist() if name.endswith(".dist-info/METADATA")]
        said = email.message_from_bytes(archive.read(path))
    assert said["Version"] == __version__
    assert f"-{__version__}-py3-none-any.whl" in wheel.name
    assert said["License-Expression"] == "Apache-2.0"
    assert said["Requires-Python"] == ">=3.11"
    assert not [need for need in said.get_all("Requires-Dist") if "@" in need or "file:" in need]
    written = [
        path for path in ROOT.glob("*.toml") if re.search(rf'version = "{re.escape(__version__)}"', path.read_text())
    ]
    assert not written, "the version stands in tableverse_factory/core/version.py alone"


@pytest.mark.slow
def test_it_runs_where_the_checkout_is_out_of_reach(tableverse, tmp_path):
    """From `--version` to a gallery, by the command that pip made."""
    for package in PACKAGES:
        path = run(
            tableverse.with_name("python"), "-c", f"import {package}; print({package}.__file__)", folder=tmp_path
        )
        assert path.startswith(str(tableverse.parents[1])), f"{path} does not come from the wheel"
    assert run(tableverse, "--version", folder=tmp_path) == f"tableverse {__version__}\n"
    run(tableverse, "init", folder=tmp_path)
    run(tableverse, "synth", "captures", "--scenes", 1, folder=tmp_path)
    run(tableverse, "manifest", "captures", "--out", "images.parquet", folder=tmp_path)
    build = ("build", "images.parquet", "out", "--config", "config.yaml", "--executor", "local")
    run(tableverse, *build, folder=tmp_path)
    assert json.loads(run(tableverse, "status", "out", "--json", folder=tmp_path))["remaining"] == 0
    assert "no motion of panda" in run(tableverse.with_name("python"), "-c", MAKE, folder=tmp_path)
    run(tableverse, "report", "out", "--jobs", 1, folder=tmp_path)
    assert (tmp_path / "out-gallery" / "index.html").is_file()


@pytest.mark.slow
@pytest.mark.usefixtures("own_authorities")
def test_it_installs_with_all_it_needs_into_an_empty_environment(wheel, tmp_path):
    """As a user does it, from the index that pip is set to: about 2 GB."""
    venv.create(tmp_path / "environment", with_pip=True)
    python = tmp_path / "environment" / "bin" / "python"
    subprocess.run([python, "-m", "pip", "install", "--quiet", "-c", ROOT / "constraints.txt", wheel], check=True)
    tableverse = python.with_name("tableverse")
    run(python, "-m", "pip", "check", folder=tmp_path)
    run(tableverse, "synth", "captures", "--scenes", 1, folder=tmp_path)
    run(tableverse, "manifest", "captures", "--out", "images.parquet", folder=tmp_path)
    run(tableverse, "build", "images.parquet", "out", "--workers", 1, folder=tmp_path)
    run(tableverse, "verify", "out", folder=tmp_path)
