"""The stage: what it keeps, what it leaves out, and that it always gives the same bytes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from schemas.codec import encode
from schemas.config import Config
from schemas.geometry import Camera, TriangleMesh
from schemas.objects import Evidence, PlacedObject, PlacedObjects, Table
from schemas.outcome import Done, Dropped, Outcome
from schemas.scene import RectifiedLayout
from tableverse_factory.core.seeding import make_rng
from tableverse_factory.evaluation.bench.layouts import find_layouts
from tableverse_factory.evaluation.bench.lccr import LayoutScore, bench_lccr
from tableverse_factory.geometry.collision.penetration import measure_mesh_penetrations, measure_piece_penetrations
from tableverse_factory.geometry.math.transforms import identity_pose
from tableverse_factory.models.services import Services
from tableverse_factory.stages.rectify.rectify import rectify
from tests.helpers.convex_layouts import ball, box, placed

TABLE = Table(np.zeros(2), np.ones(2), 0.0, (200, 200, 200), 0.0)
LINE = TriangleMesh(np.diag([0.1, 0.0, 0.0]), np.array([[0, 1, 2]], dtype=np.int32))
NAN = TriangleMesh(np.full((3, 3), np.nan), np.array([[0, 1, 2]], dtype=np.int32))


def scene(*objects: PlacedObject, evidence: Evidence | None = None) -> PlacedObjects:
    return PlacedObjects("scene", TABLE, objects, evidence)


def run(item: PlacedObjects, folder: Path, **options: str) -> Outcome[RectifiedLayout]:
    config = Config.model_validate({"rectify": options})
    return rectify(item, config, make_rng(0, item.scene_id, "rectify"), Services(folder))


def done(outcome: Outcome[RectifiedLayout]) -> RectifiedLayout:
    assert isinstance(outcome, Done), outcome
    return outcome.value


def test_the_paper_s_method_only_moves_and_poses_follow_the_objects(tmp_path: Path) -> None:
    items = (placed("b", box(0.1, 0.1, 0.1), (0.09, 0, 0.05), 0.2), placed("a", box(0.1, 0.1, 0.1), (0, 0, 0.05), 0.7))
    layout = done(run(scene(*items), tmp_path, method="lccr"))
    assert (layout.placed.objects, layout.method) == (items, "lccr")
    assert layout.penetration_before_m > 0.02
    for item, pose in zip(items, layout.poses, strict=True):
        assert pose.quaternion_wxyz.tolist() == item.pose.quaternion_wxyz.tolist()
    assert measure_piece_penetrations(layout.pieces, layout.poses, [1.0, 1.0]) == []
    assert measure_mesh_penetrations([item.mesh for item in items], layout.poses, [1.0, 1.0]) == []
    assert sorted(layout.groups) == [0, 1]


def test_the_default_is_the_joint_motion(tmp_path: Path) -> None:
    items = (placed("b", box(0.1, 0.1, 0.1), (0.09, 0, 0.05)), placed("a", box(0.1, 0.1, 0.1), (0, 0, 0.05)))
    layout = done(run(scene(*items), tmp_path))
    assert layout.method == "joint"
    assert layout.poses[0].position[0] + layout.poses[1].position[0] == pytest.approx(0.09, abs=1e-4)


def test_scale_is_applied(tmp_path: Path) -> None:
    items = [placed(name, box(1.0, 1.0, 1.0), (x, 0, 0.05)) for name, x in (("a", 0.0), ("b", 0.08))]
    items = [replace(item, scale=0.1) for item in items]
    layout = done(run(scene(*items), tmp_path))
    assert layout.poses[1].position[0] - layout.poses[0].position[0] == pytest.approx(0.1005, abs=1e-5)


@pytest.mark.heavy
def test_the_same_layout_gives_the_same_bytes_with_a_cold_and_a_warm_cache(tmp_path: Path) -> None:
    item = scene(placed("a", ball(0.05), (0, 0, 0)), placed("b", box(0.1, 0.1, 0.03), (0.03, 0, 0)))
    first = encode(run(item, tmp_path / "one"))
    assert encode(run(item, tmp_path / "one")) == first
    assert encode(run(item, tmp_path / "two")) == first


@pytest.mark.parametrize("bad", [LINE, NAN])
def test_a_hopeless_mesh_is_left_out_with_the_reason(bad: TriangleMesh, tmp_path: Path) -> None:
    layout = done(run(scene(placed("bad", bad, (0, 0, 0)), placed("good", ball(0.05), (0, 0, 0.05))), tmp_path))
    assert [item.object_id for item in layout.placed.objects] == ["good"]
    [(name, reason)] = layout.placed.left_out
    assert name == "bad"
    assert reason
    assert len(layout.poses) == len(layout.pieces) == len(layout.groups) == 1


@pytest.mark.parametrize("size", [3e-6, 40.0])
def test_what_is_no_thing_on_a_table_is_left_out(size: float, tmp_path: Path) -> None:
    odd = placed("odd", box(size, size, size), (0, 0, 0))
    layout = done(run(scene(odd, placed("good", ball(0.05), (0, 0, 0.05))), tmp_path))
    assert layout.placed.left_out[0][0] == "odd"
    assert f"{size:.3g} m" in layout.placed.left_out[0][1]


@pytest.mark.parametrize("thickness", [1e-6, 1e-5])
def test_what_is_too_thin_to_simulate_does_not_cost_the_scene(thickness: float, tmp_path: Path) -> None:
    foil = placed("foil", box(0.1, 0.1, thickness), (0.3, 0, 0))
    layout = done(run(scene(foil, placed("good", ball(0.05), (0, 0, 0.05))), tmp_path))
    assert [name for name, _ in layout.placed.left_out] == ["foil"]
    assert "thick" in layout.placed.left_out[0][1]
    assert [item.object_id for item in layout.placed.objects] == ["good"]


def test_a_scene_without_a_usable_mesh_is_dropped(tmp_path: Path) -> None:
    outcome = run(scene(placed("a", NAN, (0, 0, 0)), placed("b", LINE, (0, 0, 0))), tmp_path)
    assert isinstance(outcome, Dropped)
    assert outcome.reason == "no_usable_mesh"


def test_what_is_left_out_takes_its_pixels_along_and_frees_its_contents(tmp_path: Path) -> None:
    camera = Camera(100.0, 100.0, 1.0, 1.0, 2, 2)
    evidence = Evidence(b"jpg", b"png", (7, 3, 9), camera, identity_pose())
    items = (
        placed("a", ball(0.05), (0, 0, 0.05)),
        placed("bowl", NAN, (0.3, 0, 0)),
        placed("egg", ball(0.02), (0.3, 0, 0.1), contained_in="bowl"),
    )
    layout = done(run(scene(*items, evidence=evidence), tmp_path))
    assert layout.placed.evidence is not None
    assert layout.placed.evidence.object_pixels == (7, 9)
    assert [item.contained_in for item in layout.placed.objects] == [None, None]
    assert layout.poses[1].position[2] == pytest.approx(0.02, abs=0.002)


@pytest.mark.slow  # test_relaxation.py has a heap
@pytest.mark.heavy
def test_many_objects_in_one_place_end_free(tmp_path: Path) -> None:
    items = [placed(f"obj_{k:03d}", box(0.05, 0.05, 0.05 + 0.001 * k), (0, 0, 0), 0.1 * k) for k in range(12)]
    layout = done(run(scene(*items), tmp_path))
    assert measure_piece_penetrations(layout.pieces, layout.poses, [1.0] * 12) == []


def colliding(score: LayoutScore) -> tuple[int, int]:
    """Scenes deeper than 0.1 mm, on pieces and on meshes."""
    return sum(depth > 1e-4 for depth in score.piece_depths_m), sum(depth > 1e-4 for depth in score.mesh_depths_m)


@pytest.mark.heavy
@pytest.mark.shared
@pytest.mark.parametrize("method", [pytest.param("LCCR", marks=pytest.mark.slow), "joint"])
def test_a_real_layout_ends_free_on_pieces_and_on_meshes(shared_dir: Path, tmp_path: Path, method: str) -> None:
    folder = shared_dir / "layouts"
    scores = bench_lccr([folder / "clutter_051.json"], folder / "truth", Config(), tmp_path, ("Direct", method))
    assert colliding(scores["Direct"]) == (1, 1)
    assert colliding(scores[method]) == (0, 0)
    assert method == "joint" or max(scores[method].azimuth_changes_rad) < 1e-9


@pytest.mark.slow
@pytest.mark.shared
@pytest.mark.parametrize("method", ["LCCR", "joint"])
def test_all_layouts_end_free_on_pieces_and_on_meshes(shared_dir: Path, tmp_path: Path, method: str) -> None:
    folder = shared_dir / "layouts"
    scores = bench_lccr(find_layouts(folder, None), folder / "truth", Config(), tmp_path, (method,))
    assert colliding(scores[method]) == (0, 0)
    assert float(np.median(scores[method].from_truth_m)) < 0.012
