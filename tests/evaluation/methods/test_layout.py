"""`evaluate layout`: planted errors come out as planted, symmetric shapes are forgiven, lost relations are counted."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from typer.testing import CliRunner

from schemas.geometry import Pose, TriangleMesh
from tableverse_factory.cli.main import app
from tableverse_factory.delivery.formats.model_contents import VisualMesh
from tableverse_factory.evaluation.methods.heading import compute_heading_error, compute_heading_error_of_same
from tableverse_factory.evaluation.methods.layout import compare_layouts, compare_scene, summarize_layouts
from tableverse_factory.evaluation.methods.scenes import MethodObject, MethodScene, SceneSource
from tableverse_factory.evaluation.methods.sources import find_scenes
from tableverse_factory.evaluation.methods.truth import find_truths
from tableverse_factory.geometry.math.transforms import compose_poses, quaternion_about_z
from tableverse_factory.geometry.mesh.meshes import from_trimesh, place_mesh
from tableverse_factory.geometry.relations.preserved import PreservedRelations
from tableverse_factory.physics.render.render import look_at

pytestmark = pytest.mark.heavy


def turned(degrees: float, position: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Pose:
    return Pose(np.array(position), quaternion_about_z(np.deg2rad(degrees)))


def solid(kind: str) -> TriangleMesh:
    corners = np.array([[0, 0, 0], [0.12, 0, 0], [0, 0.05, 0], [0, 0, 0.04], [0.12, 0, 0.02]])
    return from_trimesh(
        {
            "box": lambda: trimesh.creation.box((0.1, 0.06, 0.05)),
            "square": lambda: trimesh.creation.box((0.1, 0.1, 0.05)),
            "can": lambda: trimesh.creation.cylinder(0.04, 0.1, sections=64),
            "wedge": lambda: trimesh.convex.convex_hull(corners),
        }[kind]()
    )


@pytest.mark.parametrize(
    ("kind", "degrees", "error"),
    [
        pytest.param("wedge", 0, 0, marks=pytest.mark.slow),
        ("wedge", 7, 7),
        pytest.param("wedge", -120, 120, marks=pytest.mark.slow),
        pytest.param("wedge", 180, 180, marks=pytest.mark.slow),
        pytest.param("box", 4, 4, marks=pytest.mark.slow),
        ("box", 176, 4),
        pytest.param("box", 90, 90, marks=pytest.mark.slow),
        pytest.param("square", 87, 3, marks=pytest.mark.slow),
        ("square", 45, 45),
        ("can", 30, None),
    ],
)
def test_headings_up_to_the_symmetries_of_the_shape(kind, degrees, error):
    mesh = solid(kind)
    by_shape = compute_heading_error(place_mesh(mesh, turned(degrees, (0.3, 0.1, 0.0)), 1.02), mesh)
    by_pose = compute_heading_error_of_same(mesh, np.deg2rad(degrees))
    if error is None:
        assert by_shape is None
        assert by_pose is None
    else:
        assert np.rad2deg(by_shape) == pytest.approx(error, abs=0.5)
        assert np.rad2deg(by_pose) == pytest.approx(error, abs=0.5)


@pytest.fixture
def layouts(tmp_path) -> Path:
    """A box on a box and a wedge beside them, in truth; `poses` and `scale` change what a result says."""
    (tmp_path / "meshes").mkdir()
    for kind in ("box", "wedge"):
        mesh = solid(kind)
        trimesh.Trimesh(mesh.vertices, mesh.faces).export(tmp_path / "meshes" / f"{kind}.obj")
    (tmp_path / "truth").mkdir()
    (tmp_path / "truth" / "a.json").write_text(json.dumps({name: _json(*its[1:]) for name, its in TRUE.items()}))
    return tmp_path


TRUE = {
    "below": ("box", (0.0, 0.0, 0.025), 0.0),
    "above": ("box", (0.01, 0.0, 0.075), 0.0),
    "beside": ("wedge", (0.2, 0.1, 0.0), 0.0),
}


def _json(position, degrees, scale=1.0) -> dict:
    pose = turned(degrees)
    return {"position": list(position), "quaternion_wxyz": pose.quaternion_wxyz.tolist(), "scale": scale}


def write_result(folder: Path, **changes) -> Path:
    (folder / "layouts").mkdir(exist_ok=True)
    objects = []
    for name, (kind, *its) in TRUE.items():
        entry = _json(*changes.get(name, its))
        if entry["position"]:
            scale = entry.pop("scale")
            objects.append({"id": name, "mesh": f"../meshes/{kind}.obj", "scale": scale, "pose": entry})
    (folder / "layouts" / "a.json").write_text(json.dumps({"objects": objects}))
    return folder / "layouts"


def compared(folder: Path):
    (source,) = find_scenes(folder / "layouts")
    result = source.read()
    return compare_scene("a", result, find_truths(folder / "truth")["a"](result), folder / "cache")


def test_what_is_true_has_no_errors(layouts):
    write_result(layouts)
    scene = compared(layouts)
    for match in scene.matches:
        assert match.position_error_m == pytest.approx(0.0, abs=1e-9)
        assert match.size_error == pytest.approx(0.0, abs=1e-9)
        assert match.heading_error_rad == pytest.approx(0.0, abs=1e-9)
    assert scene.kept == PreservedRelations(1, 1, 0, 0)


def test_planted_errors_come_out(layouts):
    write_result(
        layouts, below=((0.003, 0.004, 0.025), 176.0, 1.0), above=((0.01, 0.0, 0.12), 0.0, 1.03), beside=((), 0.0)
    )
    scene = compared(layouts)
    below, above, beside = scene.matches
    assert below.position_error_m == pytest.approx(0.005, abs=1e-6)
    assert np.rad2deg(below.heading_error_rad) == pytest.approx(4.0, abs=0.3)
    assert above.size_error == pytest.approx(0.03, abs=1e-6)
    assert above.position_error_m == pytest.approx(0.045, abs=1e-6)
    assert beside.found == ""
    assert scene.kept == PreservedRelations(1, 0, 0, 0), "the upper box is in the air"
    found = summarize_layouts([scene])
    assert found["found [%]"] == pytest.approx(200 / 3)
    assert found["support kept [%]"] == 0.0
    assert found["containment kept [%]"] is None


def test_turning_on_the_spot_is_no_change_of_place(layouts):
    """The box along the table's axes of a turned wedge has another centre; the wedge has not."""
    low, high = solid("wedge").vertices.min(axis=0), solid("wedge").vertices.max(axis=0)
    middle, turn = (low + high) / 2, np.deg2rad(30.0)
    around = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    position = np.array(TRUE["beside"][1]) + middle - around @ middle
    write_result(layouts, beside=(tuple(position), 30.0, 1.0))
    match = compared(layouts).matches[2]
    assert match.position_error_m == pytest.approx(0.0, abs=1e-9)
    assert np.rad2deg(match.heading_error_rad) == pytest.approx(30.0, abs=0.5)


def test_contents_that_left_their_vessel(tmp_path):
    cup = trimesh.creation.revolve([[0, 0], [0.05, 0], [0.05, 0.08], [0.046, 0.08], [0.046, 0.004], [0, 0.004]])
    things = {"cup": (cup, (0.0, 0.0, 0.0)), "egg": (trimesh.creation.icosphere(2, 0.02), (0.0, 0.0, 0.025))}
    for folder, x in (("truth", 0.0), ("kept", 0.01), ("lost", 0.12)):
        (tmp_path / folder).mkdir()
        scene = trimesh.Scene()
        for name, (mesh, (_, _, z)) in things.items():
            y_up = trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0])
            place = trimesh.transformations.translation_matrix([x if name == "egg" else 0.0, 0.0, z])
            scene.add_geometry(mesh, node_name=name, geom_name=name, transform=y_up @ place)
        scene.export(tmp_path / folder / "a.glb")
    for folder, count in (("kept", 1), ("lost", 0)):
        result = find_scenes(tmp_path / folder)[0].read()
        scene = compare_scene("a", result, find_truths(tmp_path / "truth")["a"](result), tmp_path / "cache")
        assert (scene.kept.contained, scene.kept.contained_kept) == (1, count)


def test_the_camera_joins_the_frames_of_a_capture_and_its_result(tmp_path):
    """The result's table frame is turned and shifted against the true one; the names differ and one object is extra."""
    home = tmp_path / "kitchen"
    (home / "truth").mkdir(parents=True)
    camera = look_at(np.array([0.1, -0.7, 0.5]), np.zeros(3))
    to_result = Pose(np.array([0.4, -0.2, 0.001]), quaternion_about_z(0.9))
    entries, items = [], []
    for index, (kind, pose) in enumerate((("box", turned(20)), ("wedge", turned(70, (0.25, 0.1, 0.0)))), start=1):
        mesh = solid(kind)
        trimesh.Trimesh(mesh.vertices, mesh.faces).export(home / "truth" / f"{index}.obj")
        at = {"position": pose.position.tolist(), "quaternion_wxyz": pose.quaternion_wxyz.tolist()}
        entries.append({"instance_id": index, "label": kind, "mesh": f"truth/{index}.obj", "pose": at})
        items.append(
            MethodObject(f"obj_{7 - index}", mesh, (VisualMesh(mesh, (0, 0, 0)),), compose_poses(to_result, pose))
        )
    eye = {"position": camera.position.tolist(), "quaternion_wxyz": camera.quaternion_wxyz.tolist()}
    (home / "truth.json").write_text(json.dumps({"camera_to_table": eye, "objects": entries}))
    stranger = replace(items[0], name="stranger", pose=turned(0, (-2.0, 0.0, 0.0)))
    result = MethodScene((stranger, *items), (), compose_poses(to_result, camera))
    scene = compare_scene("kitchen", result, find_truths(tmp_path)["kitchen"](result), tmp_path / "cache")
    assert [match.found for match in scene.matches] == ["obj_6", "obj_5"]
    assert scene.extra == ("stranger",)
    for match in scene.matches:
        assert match.position_error_m == pytest.approx(0.0, abs=1e-6)
        assert np.rad2deg(match.heading_error_rad) == pytest.approx(0.0, abs=0.6)
    lost = replace(result, camera_to_scene=compose_poses(to_result, compose_poses(turned(180), camera)))
    assert not all(m.found for m in compare_scene("k", lost, find_truths(tmp_path)["kitchen"](lost), tmp_path).matches)


@pytest.mark.slow  # the command five times, for its messages
def test_the_command_names_what_is_missing(layouts, monkeypatch):
    monkeypatch.setenv("TABLEVERSE_CACHE", str(layouts / "cache"))
    write_result(layouts)
    (layouts / "truth" / "b.json").write_text((layouts / "truth" / "a.json").read_text())
    arguments = ["evaluate", "layout", str(layouts / "layouts"), "--truth", str(layouts / "truth")]
    result = CliRunner().invoke(app, [*arguments, "--json"])
    assert result.exit_code == 1
    found = json.loads(result.stdout)["layouts"]
    assert found["summary"]["scenes"] == 1
    assert [scene["error"] for scene in found["scenes"]] == ["", "not among the results"]
    assert (found["summary"]["scenes missing"], found["summary"]["found [%]"]) == (1, 50.0), (
        "no gain in dropping scenes"
    )
    for name in "cdefgh":
        (layouts / "truth" / f"{name}.json").write_text((layouts / "truth" / "a.json").read_text())
    (layouts / "truth" / "h.json").rename(layouts / "truth" / "a0.json")
    (layouts / "layouts" / "a0.json").write_text("broken")
    shown = CliRunner().invoke(app, arguments).stdout.splitlines()
    named = [line for line in shown if line.startswith("not compared")]
    assert len(named) == 3
    assert "a0.json is no JSON" in named[0], "what broke comes before what is not there"
    assert shown[-1] == "… and 4 more like this; --json names all"
    for path in (*(layouts / "truth").glob("[b-h].json"), *(layouts).glob("*/a0.json")):
        path.unlink()
    shown = CliRunner().invoke(app, arguments)
    assert shown.exit_code == 0
    assert "support kept" in shown.stdout


AT = {"position": [0, 0, 0], "quaternion_wxyz": [1, 0, 0, 0]}


@pytest.mark.parametrize(
    "entry",
    [
        {"label": "a"},
        {"instance_id": 1, "label": "a", "mesh": "absent.obj", "pose": AT},
        {"instance_id": 1, "label": "a", "mesh": "../box.obj", "pose": AT},
        {"instance_id": 1, "label": "a", "mesh": "/dev/zero", "pose": AT},
        {"instance_id": 1, "label": "a", "mesh": ".", "pose": AT},
        {"instance_id": 1, "label": "a", "mesh": "nul\0.obj", "pose": AT},
        {"instance_id": 1, "label": "a", "mesh": "box.obj", "pose": {"position": [0, 0, 1e999]}},
    ],
)
def test_a_broken_truth_is_said(entry, tmp_path):
    (tmp_path / "a").mkdir()
    trimesh.creation.box().export(tmp_path / "box.obj")
    (tmp_path / "a" / "truth.json").write_text(json.dumps({"camera_to_table": AT, "objects": [entry]}))
    (row,) = compare_layouts(
        {"a": SceneSource("a", "glb", lambda: MethodScene(()))}, find_truths(tmp_path), tmp_path / "cache"
    )
    assert row.error
    assert row.matches == ()
