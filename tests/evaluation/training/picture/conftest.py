"""A few meshes at rest, and what is made of them."""

from pathlib import Path
from typing import Any

import pytest

from tableverse_factory.evaluation.training.picture.pool import MeshPool, make_pool

SMALL = {"scenes": 2, "batch": 2, "width": 64, "height": 64, "packages": 4, "patterns": 12, "flat": 8}
SMALL |= {"capacity": 64, "first": 8, "fresh": 50.0}  # three steps render more views than are kept


@pytest.fixture(scope="package")
def pool() -> MeshPool:
    """The meshes of two arrangements: one of training, one held out."""
    return make_pool(2, seed=1)


@pytest.fixture(scope="package")
def pool_file(pool: MeshPool, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The pool on the disk."""
    path = tmp_path_factory.mktemp("pool") / "meshes.npz"
    pool.write(path)
    return path


@pytest.fixture(scope="package")
def world(pool_file: Path) -> Any:
    """What a training of 96 x 80 pixels reads."""
    pytest.importorskip("torch", reason="the extra `models` is not installed")
    from tableverse_factory.evaluation.training.picture.settings import PictureSettings
    from tableverse_factory.evaluation.training.picture.world import make_world

    return make_world(pool_file, PictureSettings(1, **SMALL | {"width": 96, "height": 80}), 0)


@pytest.fixture
def thin(monkeypatch: pytest.MonkeyPatch) -> None:
    """A network of the same layers, but few channels."""
    pytest.importorskip("torch", reason="the extra `models` is not installed")
    from tableverse_factory.evaluation.training.picture import network

    monkeypatch.setattr(network, "WIDTHS", (8, 16, 24, 32))
    monkeypatch.setattr(network, "ATTENTION", 1)
