"""The stage settle: rest where there is rest, a true reason where there is none."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from schemas.codec import encode
from schemas.config import Config, SettleConfig
from schemas.geometry import Pose, TriangleMesh
from schemas.outcome import Done, Dropped, Outcome
from schemas.scene import RectifiedLayout, SettledScene
from tableverse_factory.geometry.math.transforms import rotation_angle
from tableverse_factory.geometry.mesh.meshes import from_trimesh
from tableverse_factory.models.services import Services
from tableverse_factory.stages.settle import list_seen_poses, settle
from tests.helpers.simple_scenes import TABLE, Solid, ball, box, cylinder, layout


def run(rectified: RectifiedLayout, config: Config | None = None) -> Outcome[SettledScene]:
    return settle(rectified, config or Config(), np.random.default_rng(0), Services(Path("unused")))


def settled(rectified: RectifiedLayout) -> SettledScene:
    outcome = run(rectified)
    assert isinstance(outcome, Done), outcome
    return outcome.value


def dropped(outcome: Outcome[SettledScene]) -> Dropped:
    assert isinstance(outcome, Dropped)
    return outcome


STACK = [Solid(box(0.1, 0.08, 0.04), (0.0, 0.0, 0.0205 + 0.0405 * k)) for k in range(3)]
CLUTTER = [*STACK, Solid(cylinder(0.03, 0.12, 24), (0.15, 0.02, 0.0605), "can"), Solid(ball(0.03), (-0.15, 0, 0.031))]


def test_clutter_comes_to_rest_where_it_stood() -> None:
    scene = settled(layout(CLUTTER))
    assert scene.settle_time_s < 2.0
    for solid, pose in zip(CLUTTER, scene.poses, strict=True):
        assert np.linalg.norm(pose.position - solid.pose.position) < 0.003
    for solid, pose in zip(CLUTTER[:4], scene.poses, strict=False):
        assert rotation_angle(pose.quaternion_wxyz, solid.pose.quaternion_wxyz) < 0.01


def test_equal_layouts_give_equal_bytes() -> None:
    assert encode(run(layout(CLUTTER))) == encode(run(layout(CLUTTER)))


def test_a_ball_that_rolls_off_is_named() -> None:
    # A wedge that ends at the table's edge: the table reaches 0.1 m beyond, a ball that rolls down goes further.
    solids = [Solid(_ramp(0.4, 0.2, 0.3), (0.0, 0.0, 0.0005)), Solid(_smooth_ball(), (0.06, 0.0, 0.31))]
    outcome = dropped(run(layout(solids)))
    assert outcome.reason == "object_fell"
    assert "obj_001" in outcome.detail


def test_what_cannot_come_to_rest_in_time_is_named_with_its_speed() -> None:
    config = Config(settle=SettleConfig(max_time_s=0.5))
    outcome = dropped(run(layout([Solid(box(0.05, 0.05, 0.05), (0, 0, 3.0))]), config))
    assert outcome.reason == "not_at_rest"
    assert "obj_000" in outcome.detail


def test_ids_that_mjcf_cannot_hold_are_named() -> None:
    outcome = dropped(run(layout([Solid(box(0.05, 0.05, 0.05), (0, 0, 0.0255), object_id="table")])))
    assert (outcome.reason, "table" in outcome.detail) == ("reserved_object_id", True)


@pytest.mark.parametrize("size", [(3e-6, 3e-6, 3e-6), (0.1, 0.1, 1e-6)])
def test_things_too_small_to_simulate_are_named(size: tuple[float, float, float]) -> None:
    outcome = dropped(run(layout([STACK[0], Solid(box(*size), (0.2, 0, 0.01))])))
    assert outcome.reason == "unusable_mesh"
    assert outcome.detail.startswith("obj_001: ")


def test_pieces_at_scale_and_an_open_mesh_settle_too() -> None:
    whole = box(1.0, 1.0, 1.0)
    sheet = TriangleMesh(whole.vertices, whole.faces[:-1])
    scene = settled(layout([Solid(sheet, (0, 0, 0.0255), scale=0.05, hulls=(whole,))]))
    np.testing.assert_allclose(scene.poses[0].position, [0, 0, 0.025], atol=1e-4)


def test_a_table_seen_in_part_does_not_let_its_objects_fall() -> None:
    seen = replace(TABLE, center_xy=np.array([0.5, 0.5]), half_size_xy=np.array([0.05, 0.05]), yaw=0.4)
    assert isinstance(run(layout(CLUTTER, seen)), Done)


def test_what_topples_is_put_back_where_it_was_seen_but_not_after_the_papers_method() -> None:
    upright = layout([Solid(box(0.02, 0.1, 0.16), (0.0, 0.0, 0.0803)), Solid(box(0.1, 0.1, 0.04), (-0.2, 0, 0.0203))])
    half = np.radians(12.0) / 2
    toppling = Pose(np.array([0.0, 0.0, 0.0885]), np.array([np.cos(half), 0.0, np.sin(half), 0.0]))
    poses = (toppling, upright.poses[1])
    for method, height in (("joint", 0.08), ("lccr", 0.01)):
        scene = settled(replace(upright, poses=poses, method=method))
        assert scene.poses[0].position[2] == pytest.approx(height, abs=2e-4)


def test_contents_and_their_containers_are_not_put_back() -> None:
    solids = [
        Solid(box(0.1, 0.1, 0.1), (0.2 * k, 0.0, 0.05), contained_in="obj_001" if k == 0 else None) for k in range(3)
    ]
    assert list(list_seen_poses(layout(solids).placed.objects)) == ["obj_002"]


def _ramp(length: float, width: float, height: float) -> TriangleMesh:
    """A wedge that is high at x = 0, standing on z = 0 around y = 0."""
    corners = [(x, y, z) for y in (-width / 2, width / 2) for x, z in ((0.0, 0.0), (length, 0.0), (0.0, height))]
    return from_trimesh(trimesh.Trimesh(np.array(corners)).convex_hull)


def _smooth_ball() -> TriangleMesh:
    points = trimesh.creation.icosphere(2, 0.03).vertices[::3][:60]
    return from_trimesh(trimesh.Trimesh(points).convex_hull)
