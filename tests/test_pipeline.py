"""A stage reads of the configuration what it says and nothing else: by this its records are found again, or not."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from schemas.config import Config
from schemas.manifest import ImageRow, SceneKind
from schemas.outcome import Done
from tableverse_factory.core.seeding import make_rng
from tableverse_factory.models.services import Services
from tableverse_factory.pipeline import PIPELINES, WITH_TRAJECTORIES
from tableverse_factory.sources.manifest import make_manifest
from tableverse_factory.sources.synthetic.synthesize import synthesize_captures
from tests.helpers.captures_on_disk import write_layout


class Watched:
    """A configuration, or a section of it, that notes the names of the values that are read."""

    def __init__(self, value: Any, name: str, read: set[str]) -> None:
        self._value, self._name, self._read = value, name, read

    def __getattr__(self, name: str) -> Any:
        value = getattr(self._value, name)
        if not self._name:
            return Watched(value, name, self._read)
        if name in type(self._value).model_fields:
            self._read.add(f"{self._name}.{name}")
        elif isinstance(getattr(type(self._value), name, None), property):  # it reads others: through this, too
            return getattr(type(self._value), name).fget(self)
        return value


@pytest.fixture(scope="module")
def entries(tmp_path_factory) -> list[ImageRow]:
    folder = tmp_path_factory.mktemp("line")
    synthesize_captures(folder / "in", 1, seed=5)
    write_layout(folder / "in" / "box" / "box.json")
    return list(make_manifest([str(folder / "in")], Config().observe).rows)


@pytest.mark.heavy
@pytest.mark.parametrize("kind", [SceneKind.CAPTURE, SceneKind.LAYOUT])
def test_stages_read_what_they_declare(entries, tmp_path, kind):
    row = next(row for row in entries if row.kind is kind)
    item: Any = row
    for stage in PIPELINES[kind]:
        read: set[str] = set()
        watched: Any = Watched(Config(), "", read)
        outcome = stage.run(item, watched, make_rng(0, row.scene_id, stage.name), Services(Path(tmp_path)))
        assert isinstance(outcome, Done), outcome
        undeclared = read - set(stage.select_values(Config()))
        assert not undeclared, f"{stage.name} reads {undeclared} and does not say so"
        item = outcome.value


@pytest.mark.heavy
@pytest.mark.parametrize("module", ["workers.api", pytest.param("tableverse_factory.pipeline", marks=pytest.mark.slow)])
def test_whoever_only_plans_a_build_imports_no_native_code_of_stages(module):
    line = f"import sys, {module}; print(*({{'open3d', 'mujoco', 'scipy', 'trimesh', 'coal'}} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", line], check=True, capture_output=True, text=True).stdout.split() == []


def test_the_functions_of_all_stages_are_there():
    assert all(callable(stage.run.load()) for line in WITH_TRAJECTORIES.values() for stage in line)


def test_what_a_stage_declares_is_there():
    for line in PIPELINES.values():
        for stage in line:
            assert stage.section in Config.model_fields
            assert stage.select_values(Config())
            assert not any(name.endswith("deadline_s") for name in stage.select_values(Config()))
