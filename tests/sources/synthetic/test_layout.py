"""Synthetic layouts: readable, with the stated noise, and true to the scene of the capture."""

import json
from pathlib import Path

import numpy as np
import pytest

from schemas.config import Config, ObserveConfig
from schemas.geometry import Pose
from schemas.manifest import ImageRow, SceneKind
from schemas.outcome import Done
from tableverse_factory.core.errors import InputError
from tableverse_factory.geometry.collision.penetration import measure_mesh_penetrations
from tableverse_factory.geometry.math.transforms import normalize_quaternion, rotation_angle, transform_points
from tableverse_factory.geometry.mesh.meshes import box_center, read_mesh
from tableverse_factory.models.services import Services
from tableverse_factory.sources.manifest import make_manifest
from tableverse_factory.sources.synthetic.layout import synthesize_layouts
from tableverse_factory.sources.synthetic.synthesize import make_synthetic_scene
from tableverse_factory.stages.observe.observe import read_layout

pytestmark = pytest.mark.heavy

SEED, SCENES = 5, 6


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("layouts") / "out"
    synthesize_layouts(out, SCENES, SEED)
    return out


def truth_of(path: Path) -> dict[str, Pose]:
    entries = json.loads((path.parent.parent / "truth" / path.name).read_text())
    return {
        name: Pose(np.array(entry["position"]), normalize_quaternion(np.array(entry["quaternion_wxyz"])))
        for name, entry in entries.items()
    }


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_layouts_are_read_and_wrong_by_the_noise_alone(folder: Path) -> None:
    shifts, angles, scales = [], [], []
    for path in sorted((folder / "layouts").glob("synth_*.json")):
        row = ImageRow(scene_id=path.stem, kind=SceneKind.LAYOUT, uri=str(path))
        outcome = read_layout(row, Config(), np.random.default_rng(0), Services(Path()))
        assert isinstance(outcome, Done)
        truth = truth_of(path)
        assert [placed.object_id for placed in outcome.value.objects] == list(truth)
        for placed in outcome.value.objects:
            center, true = box_center(placed.mesh)[None], truth[placed.object_id]
            shifts.append((transform_points(placed.pose, center, placed.scale) - transform_points(true, center))[0])
            angles.append(rotation_angle(placed.pose.quaternion_wxyz, true.quaternion_wxyz))
            scales.append(placed.scale)
    assert np.std(shifts, axis=0) == pytest.approx([0.007, 0.007, 0.0035], rel=0.35)
    assert np.sqrt(np.mean(np.square(angles))) == pytest.approx(np.deg2rad(np.sqrt(4**2 + 2 * 1**2)), rel=0.35)
    assert np.std(scales) == pytest.approx(0.03, rel=0.35)


def test_layouts_have_the_licence_of_captures(folder: Path) -> None:
    made = make_manifest([str(folder)], ObserveConfig())
    assert {(row.source, row.licence, row.rejected) for row in made.rows} == {("synthetic", "CC0-1.0", "")}
    assert len(made.rows) == SCENES


def test_the_truth_is_the_scene_of_the_capture_and_rests_free_of_collision(folder: Path) -> None:
    path = folder / "layouts" / "synth_000001.json"
    truth, scene = truth_of(path), make_synthetic_scene(SEED, 1)
    layout = {item["id"]: item for item in json.loads(path.read_text())["objects"]}
    meshes = []
    for index, ((name, pose), item) in enumerate(zip(truth.items(), scene.objects, strict=True)):
        assert pose.position == pytest.approx(item.placed.pose.position, abs=1e-8)
        holder = layout[name].get("contained_in")
        assert (None if holder is None else list(truth).index(holder)) == item.contained_in, index
        file = (path.parent / layout[name]["mesh"]).resolve()
        meshes.append(read_mesh(file.read_bytes(), file.name))
    depths = measure_mesh_penetrations(meshes, list(truth.values()), [1.0] * len(meshes))
    assert max((depth for _, _, depth in depths), default=0.0) < 0.001


def test_same_bytes_whatever_the_number_and_after_an_interruption(folder: Path, tmp_path: Path) -> None:
    synthesize_layouts(tmp_path / "out", 1, SEED)
    few, many = contents(tmp_path / "out"), contents(folder)
    assert few == {name: many[name] for name in few}
    # Killed before the layout itself was written: it is made again, and what is whole is kept.
    (tmp_path / "out" / "layouts" / "synth_000000.json").unlink()
    made = []
    synthesize_layouts(tmp_path / "out", 2, SEED, lambda path, new: made.append((path.name, new)))
    assert made == [("synth_000000.json", True), ("synth_000001.json", True)]
    again = contents(tmp_path / "out")
    assert again == {name: many[name] for name in again}


def test_other_folders_and_other_seeds_are_refused(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="same seed"):
        synthesize_layouts(folder, 1, SEED + 1)
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="holds other files"):
        synthesize_layouts(tmp_path, 1, SEED)
    with pytest.raises(InputError, match="scenes is 0"):
        synthesize_layouts(tmp_path / "new", 0, SEED)
