"""Objects whose meshes a model makes: what is asked, what comes back is turned, closed, small, coloured, and placed."""

import struct
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from schemas.config import Config, PerceiveConfig, PlaceConfig
from schemas.geometry import TriangleMesh
from schemas.manifest import ImageRow, SceneKind
from schemas.objects import PerceivedObjects, PlacedObjects
from schemas.outcome import Done, Dropped
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.evaluation.bench.placement import read_placement_truth
from tableverse_factory.geometry.math.transforms import compose_poses, invert_pose
from tableverse_factory.geometry.mesh.meshes import place_mesh, to_trimesh
from tableverse_factory.models.services import Services
from tableverse_factory.sources.synthetic.synthesize import synthesize_captures
from tableverse_factory.stages.observe.observe import observe
from tableverse_factory.stages.perceive.perceive import perceive
from tableverse_factory.stages.place.interfaces import Completion
from tableverse_factory.stages.place.mesh_service import model_completion
from tableverse_factory.stages.place.mesh_service.client import MeshFile
from tableverse_factory.stages.place.mesh_service.model_completion import MAX_FACES, complete_with_model, convert_mesh
from tableverse_factory.stages.place.place import place
from tableverse_factory.stages.place.view.object_view import view_object
from tableverse_factory.stages.place.view.support_from_depth import DepthSupport
from tests.helpers.mesh_daemons import daemons_inside
from tests.helpers.paths import HELPERS
from tests.stages.place.test_place import box, cup, seen

SERVER = HELPERS / "mesh_server.py"
TRIPOSR = SERVER.parents[2] / "deploy" / "mesh" / "triposr.py"
Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""From z up to y up, as exporters of GLB turn."""


@pytest.fixture(autouse=True)
def inside(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    with daemons_inside(monkeypatch):
        yield


def file_of(data: bytes, form: str, up: str) -> MeshFile:
    return MeshFile(data, form, up, "tetra", "CC0-1.0")


def by_model(*arguments: object, **keys: object) -> Config:
    command = (sys.executable, *map(str, arguments))
    return Config(
        perceive=PerceiveConfig(detector="replay"), place=PlaceConfig(mesh_model="sam3d", mesh_command=command, **keys)
    )


def hook() -> trimesh.Trimesh:
    """A thing without any symmetry: three boxes of different lengths along the axes, from one corner."""
    parts = [
        trimesh.creation.box(bounds=[(0, 0, 0), size]) for size in ((1, 0.1, 0.1), (0.1, 0.6, 0.1), (0.1, 0.1, 0.3))
    ]
    return trimesh.boolean.union(parts, engine="manifold")


@pytest.mark.parametrize(
    ("form", "up"), [("glb", "y"), ("glb", "z"), ("ply", "y"), ("ply", "z"), ("obj", "y"), ("stl", "z")]
)
def test_whatever_way_a_file_names_as_up_is_up_and_nothing_is_mirrored(form: str, up: str):
    mesh = hook()
    expected = mesh.copy()
    expected.apply_translation(-mesh.bounds.mean(axis=0))
    if up == "y":
        mesh.vertices = mesh.vertices @ Y_UP.T
    mesh.vertices = 37.0 * mesh.vertices + 5.0
    data = mesh.export(file_type=form)
    got = convert_mesh(file_of(data.encode() if isinstance(data, str) else data, form, up))
    assert to_trimesh(got).is_watertight
    assert to_trimesh(got).volume > 0.0
    np.testing.assert_allclose(np.ptp(got.vertices, axis=0), np.ptp(expected.vertices, axis=0), atol=1e-3)
    np.testing.assert_allclose(to_trimesh(got).center_mass, expected.center_mass, atol=1e-3)


@pytest.mark.heavy
def test_a_mesh_of_many_faces_becomes_small_closed_and_keeps_its_shape_and_colours():
    ball = trimesh.creation.icosphere(6)  # 81,920 faces
    shown = np.where(ball.vertices[:, 2:] > 0.0, (200, 30, 20), (20, 30, 200))
    ball = trimesh.Trimesh(ball.vertices, ball.faces, vertex_colors=shown, process=False)
    got = convert_mesh(file_of(ball.export(file_type="glb"), "glb", "z"))
    assert len(got.faces) <= MAX_FACES
    assert to_trimesh(got).is_watertight
    np.testing.assert_allclose(np.linalg.norm(got.vertices, axis=1), 0.5, atol=2e-3)
    assert got.vertex_colors is not None
    upper = got.vertices[:, 2] > 0.05
    assert (got.vertex_colors[upper] == (200, 30, 20)).all()
    assert (got.vertex_colors[got.vertices[:, 2] < -0.05] == (20, 30, 200)).all()


def test_a_texture_becomes_colours_of_vertices():
    ball = trimesh.creation.icosphere(4)
    picture = Image.fromarray(np.array([[(200, 30, 20)], [(20, 30, 200)]], dtype=np.uint8))  # red above, blue below
    uv = np.stack([np.full(len(ball.vertices), 0.5), (ball.vertices[:, 2] + 1.0) / 2], axis=1)
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=picture)
    ball.visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    got = convert_mesh(file_of(ball.export(file_type="glb"), "glb", "z"))
    assert got.vertex_colors is not None
    assert np.abs(got.vertex_colors[got.vertices[:, 2] > 0.1].astype(int) - (200, 30, 20)).max() < 5
    assert np.abs(got.vertex_colors[got.vertices[:, 2] < -0.1].astype(int) - (20, 30, 200)).max() < 5


def test_crumbs_beside_a_mesh_are_dropped_and_holes_are_closed():
    cube = trimesh.creation.box((1, 1, 1))
    cube.update_faces(np.arange(len(cube.faces)) > 0)
    crumb = trimesh.creation.icosphere(2, 0.05)
    crumb.apply_translation((0.9, 0, 0))
    data = trimesh.util.concatenate([cube, crumb]).export(file_type="ply")
    got = to_trimesh(convert_mesh(file_of(data, "ply", "z")))
    assert got.is_watertight
    assert got.volume == pytest.approx(np.prod(got.extents), rel=1e-3)


def ply_of(n_faces: int) -> bytes:
    """The same triangle again and again: the file is small for what it claims."""
    head = (
        "ply\nformat binary_little_endian 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {n_faces}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    corners = struct.pack("<9f", 0, 0, 0, 1, 0, 0, 0, 1, 0)
    return head.encode() + corners + struct.pack("<B3i", 3, 0, 1, 2) * n_faces


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("data", "form", "why"),
    [
        (b"", "glb", "does not decode"),
        (b"glTF" + bytes(1000), "glb", "does not decode"),
        (b"# nothing\n", "obj", "no triangles"),
        (b"v 0 0 0\nv nan 0 0\nv 0 1 0\nf 1 2 3\n", "obj", "NaN or infinite"),
        (b"v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "obj", "no surface"),
        (b"v 0 0 0\nv 0 0 0\nv 0 0 0\nf 1 2 3\n", "obj", "0 m large"),
        (ply_of(2_000_001), "ply", "2000001 triangles; at most 2000000"),
    ],
)
def test_what_is_no_mesh_is_an_error_that_says_so(data: bytes, form: str, why: str):
    with pytest.raises(GeometryError, match=why):
        convert_mesh(file_of(data, form, "z"))


@pytest.mark.heavy
def test_an_object_whose_mesh_is_none_is_left_out_with_the_reason(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    scene = seen(box(0.06, 0.05, 0.1), box(0.05, 0.05, 0.06, x=0.2))
    monkeypatch.setattr(model_completion, "_SEEDS", 667)
    seeds = iter([1, 666])
    order = model_completion._build_query
    monkeypatch.setattr(model_completion, "_build_query", lambda *of: replace(order(*of), seed=next(seeds)))
    outcome = place(scene, by_model(SERVER, "nan"), np.random.default_rng(0), Services(tmp_path))
    assert isinstance(outcome, Done), outcome
    assert [item.object_id for item in outcome.value.objects] == ["obj_000"]
    assert outcome.value.objects[0].completion == "sam3d/tetra@1"
    assert outcome.value.objects[0].mesh_licence == "CC0-1.0"
    ((name, why),) = outcome.value.left_out
    assert name == "obj_001"
    assert "NaN" in why


def test_a_scene_whose_objects_have_too_few_points_asks_nothing(tmp_path: Path):
    scene = seen(box(0.06, 0.05, 0.1))
    bare = replace(
        scene.objects[0], points_camera=scene.objects[0].points_camera[:3], colors=scene.objects[0].colors[:3]
    )
    outcome = place(replace(scene, objects=(bare,)), by_model("/nowhere"), np.random.default_rng(0), Services(tmp_path))
    assert isinstance(outcome, Dropped)


def seeds_of(scene: PerceivedObjects, run_seed: int, monkeypatch: pytest.MonkeyPatch, cache: Path) -> list[int]:
    drawn: list[int] = []
    order = model_completion._build_query

    def noted(*of: object) -> object:
        made = order(*of)
        drawn.append(made.seed)
        return made

    with monkeypatch.context() as patch:
        patch.setattr(model_completion, "_build_query", noted)
        completions(scene, run_seed, cache)
    return drawn


def completions(scene: PerceivedObjects, run_seed: int, cache: Path) -> Sequence[Completion | GeometryError]:
    sightings = [view_object(scene, item, DepthSupport(0.0, np.zeros((0, 2)))) for item in scene.objects]
    config = by_model(TRIPOSR, "--self-test").place
    return complete_with_model(scene, sightings, config, np.random.default_rng(run_seed), Services(cache))


@pytest.mark.heavy
def test_an_objects_seed_depends_on_run_scene_and_pixels_and_not_on_its_neighbours(monkeypatch, tmp_path):
    scene = seen(box(0.06, 0.05, 0.1), cup(0.04, 0.09, 0.004, x=0.2))
    both = seeds_of(scene, 0, monkeypatch, tmp_path)
    assert seeds_of(replace(scene, objects=scene.objects[1:]), 0, monkeypatch, tmp_path) == both[1:]
    assert len({*both, *seeds_of(scene, 1, monkeypatch, tmp_path)}) == 4


@pytest.mark.heavy
def test_equal_input_gives_equal_bytes_with_and_without_what_was_kept(tmp_path: Path):
    scene = seen(box(0.06, 0.05, 0.1))
    first, kept = (completions(scene, 0, tmp_path / "one") for _ in range(2))
    again = completions(scene, 0, tmp_path / "two")
    for other in (kept, again):
        assert other[0].mesh.vertices.tobytes() == first[0].mesh.vertices.tobytes()
        assert other[0].mesh.faces.tobytes() == first[0].mesh.faces.tobytes()


def errors_of(capture: Path, config: Config, cache: Path) -> tuple[PlacedObjects, list[float], list[float]]:
    """What was placed; how far the middle of each object's box is from the truth [m], and its size off, as a share."""
    item = ImageRow(scene_id=capture.name, kind=SceneKind.CAPTURE, uri=str(capture))
    value: object = item
    for stage in (observe, perceive, place):
        outcome = stage(value, config, np.random.default_rng(0), Services(cache))
        assert isinstance(outcome, Done), outcome
        value = outcome.value
    assert isinstance(value, PlacedObjects)
    truth = read_placement_truth(capture)
    true = {entry.instance_id: entry for entry in truth.objects}
    assert value.evidence is not None
    to_truth = value.evidence.camera_to_table, truth.camera_to_table
    shifts, sizes = [], []
    for placed, instance_id in zip(value.objects, value.evidence.object_pixels, strict=True):
        standing = moved(place_mesh(placed.mesh, placed.pose, placed.scale), *to_truth)
        low, high = (getattr(standing.vertices, side)(axis=0) for side in ("min", "max"))
        wanted = true[instance_id].standing.vertices
        shifts.append(float(np.linalg.norm((low + high) / 2 - (wanted.min(axis=0) + wanted.max(axis=0)) / 2)))
        sizes.append(float(np.abs((high - low) / np.ptp(wanted, axis=0) - 1.0).mean()))
    return value, shifts, sizes


def moved(mesh: TriangleMesh, ours: object, theirs: object) -> TriangleMesh:
    return place_mesh(mesh, compose_poses(theirs, invert_pose(ours)))


@pytest.mark.slow
def test_true_meshes_y_up_and_of_unit_size_stand_where_the_objects_are(tmp_path: Path):
    (capture,) = synthesize_captures(tmp_path / "captures", 1, seed=21)
    placed, shifts, sizes = errors_of(capture, by_model(SERVER, "well", tmp_path / "captures"), tmp_path / "cache")
    assert {item.completion for item in placed.objects} == {"sam3d/tetra@1"}
    assert np.median(shifts) <= 0.006
    assert np.median(sizes) <= 0.06


def test_a_mesh_model_needs_its_command_and_has_time_to_load_where_no_deadline_is_set():
    with pytest.raises(ValueError, match=r"'triposr' needs place\.mesh_command"):
        PlaceConfig(mesh_model="triposr")
    config = by_model("x.py", mesh_timeout_s=10.0)
    assert config.run.deadline_s + 1000.0 < config.get_deadline("place") < 7200.0
    assert by_model("x.py", deadline_s=5.0).get_deadline("place") == 5.0
    assert Config().get_deadline("place") == Config().run.deadline_s
