"""`tableverse bench layout`: every scene cold and warm, every stage of it, and what went no further is said."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from tableverse_factory.cli.main import app
from tableverse_factory.evaluation.bench.stages import COMMIT, RECORDS

pytestmark = pytest.mark.heavy

STAGES = ["read_layout", "rectify", "settle", "curate", "export", RECORDS, COMMIT]
CORNERS = [(x, y, z) for x in (-0.03, 0.03) for y in (-0.03, 0.03) for z in (-0.03, 0.03)]
FACES = ["1 2 4", "1 4 3", "5 7 8", "5 8 6", "1 5 6", "1 6 2", "3 4 8", "3 8 7", "1 3 7", "1 7 5", "2 6 8", "2 8 4"]


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Mapping[str, Any]:
    folder = tmp_path_factory.mktemp("bench") / "layouts"
    (folder.parent / "meshes").mkdir()
    folder.mkdir()
    cube = "".join(f"v {x} {y} {z}\n" for x, y, z in CORNERS) + "".join(f"f {face}\n" for face in FACES)
    (folder.parent / "meshes" / "cube.obj").write_text(cube)
    for name, mesh in (("good", "cube.obj"), ("lost", "nowhere.obj")):
        objects = [
            {
                "id": f"obj_{k:03d}",
                "label": "wooden block",
                "mesh": f"../meshes/{mesh}",
                "pose": {"position": [0.05 * k, 0.0, 0.03], "quaternion_wxyz": [1, 0, 0, 0]},
            }
            for k in range(2)
        ]
        (folder / f"{name}.json").write_text(json.dumps({"scene_id": name, "objects": objects}))
    done = CliRunner().invoke(app, ["bench", "layout", str(folder), "--json"])
    assert done.exit_code == 0, done.output
    found: Mapping[str, Any] = json.loads(done.stdout)
    return found


def test_every_scene_is_measured_cold_and_warm(measured: Mapping[str, Any]) -> None:
    done = [scene for scene in measured["scenes"] if scene["ended"] == "done"]
    assert [scene["cache"] for scene in done] == ["cold", "warm"]
    for scene in done:
        assert list(scene["cpu_s"]) == STAGES
        assert all(seconds >= 0.0 for seconds in scene["cpu_s"].values())
        assert scene["objects"] == 2


def test_a_scene_that_cannot_be_read_is_named_with_its_reason(measured: Mapping[str, Any]) -> None:
    assert len(measured["scenes"]) == 4
    assert all("missing_mesh" in scene["ended"] for scene in measured["scenes"] if scene["ended"] != "done")


def test_where_nothing_was_measured_the_command_fails(tmp_path: Path) -> None:
    pose = {"position": [0.0, 0.0, 0.03], "quaternion_wxyz": [1, 0, 0, 0]}
    thing = {"id": "obj_000", "label": "wooden block", "mesh": "nowhere.obj", "pose": pose}
    (tmp_path / "lost.json").write_text(json.dumps({"scene_id": "lost", "objects": [thing]}))
    done = CliRunner().invoke(app, ["bench", "layout", str(tmp_path)])
    assert done.exit_code == 1
    assert "missing_mesh" in done.stdout
