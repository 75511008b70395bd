"""Isolated free fall: a ball tells an open vessel from a closed one, and what falls keeps its gap."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from schemas.geometry import Pose, TriangleMesh
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.geometry.math.transforms import identity_pose, normalize_quaternion
from tableverse_factory.geometry.mesh.hulls import make_bounded_hull
from tableverse_factory.physics.mjcf.spec import SceneBody, make_scene_body
from tableverse_factory.physics.simulate.freefall import simulate_fall
from tableverse_factory.sources.synthetic import vessels
from tableverse_factory.sources.synthetic.model import GeneratedObject
from tests.helpers.cavity_probe import holds_probe
from tests.helpers.simple_scenes import UPRIGHT, box

VESSELS = (vessels.make_bowl, vessels.make_mug, vessels.make_cup, vessels.make_pan)


def pieces_of(model: GeneratedObject) -> tuple[TriangleMesh, ...]:
    return tuple(make_bounded_hull(piece, 64, 1e-4) for piece in model.pieces)


@pytest.mark.parametrize("make", VESSELS)
def test_an_open_vessel_holds_the_probe_and_its_hull_does_not(
    make: Callable[[np.random.Generator], GeneratedObject],
) -> None:
    model = make(np.random.default_rng(0))
    assert holds_probe(model.mesh, pieces_of(model), identity_pose())
    assert not holds_probe(model.mesh, (make_bounded_hull(model.mesh.vertices, 64, 1e-4),), identity_pose())


def test_the_probe_knows_pose_and_scale() -> None:
    model = vessels.make_mug(np.random.default_rng(1))
    pose = Pose(np.array([0.4, -0.2, 0.1]), normalize_quaternion(np.array([1.0, 0.05, 0.0, 2.0])))
    assert holds_probe(model.mesh, pieces_of(model), pose, scale=1.5)


@pytest.mark.parametrize("quaternion", [UPRIGHT, np.array([0.0, 1.0, 0.0, 0.0])])
def test_what_has_no_cavity_as_it_stands_says_so(quaternion: np.ndarray) -> None:
    mesh = box(0.1, 0.1, 0.1) if quaternion[0] else vessels.make_mug(np.random.default_rng(0)).mesh
    with pytest.raises(GeometryError, match="no cavity"):
        holds_probe(mesh, (make_bounded_hull(mesh.vertices, 64, 1e-4),), Pose(np.zeros(3), quaternion))


def body(name: str, mesh: TriangleMesh, at: tuple[float, float, float]) -> SceneBody:
    return make_scene_body(name, mesh, (mesh,), 1.0, 0.1, Pose(np.array(at), UPRIGHT))


def test_what_falls_rests_a_gap_above_what_stands_still() -> None:
    floor, cube = box(0.2, 0.2, 0.02), box(0.04, 0.04, 0.04)
    rest = simulate_fall(
        [body("floor", floor, (0.0, 0.0, 1.0))],
        [body("low", cube, (0.0, 0.0, 1.05)), body("high", cube, (0.0, 0.0, 1.1))],
        gap_m=0.001,
        timestep_s=0.002,
        max_time_s=3.0,
    )
    assert rest.at_rest
    heights = [pose.position[2] for pose in rest.poses]
    np.testing.assert_allclose(heights, [1.01 + 0.001 + 0.02, 1.01 + 0.002 + 0.06], atol=5e-5)


def test_there_is_nothing_else_around() -> None:
    floor, cube = box(0.2, 0.2, 0.02), box(0.04, 0.04, 0.04)
    fixed = [body("floor", floor, (0.0, 0.0, -0.5))]
    on_it = simulate_fall(fixed, [body("cube", cube, (0.0, 0.0, -0.4))], gap_m=0.0, timestep_s=0.002, max_time_s=3.0)
    assert on_it.at_rest
    beside = simulate_fall(fixed, [body("cube", cube, (0.5, 0.0, 0.3))], gap_m=0.0, timestep_s=0.002, max_time_s=3.0)
    assert not beside.at_rest
    assert beside.poses[0].position[2] < -0.5
    assert beside.time_s < 2.0


def test_without_friction_things_slide_down_where_they_else_stay() -> None:
    slope = box(0.4, 0.2, 0.02)
    tilted = Pose(np.zeros(3), np.array([np.cos(0.15), 0.0, np.sin(0.15), 0.0]))  # 17°, downhill to +x
    fixed = [replace(body("slope", slope, (0.0, 0.0, 0.0)), pose=tilted)]
    cube = [body("cube", box(0.04, 0.04, 0.01), (0.0, 0.0, 0.03))]
    kept = simulate_fall(fixed, cube, gap_m=0.0, timestep_s=0.002, max_time_s=3.0)
    slid = simulate_fall(fixed, cube, gap_m=0.0, timestep_s=0.002, max_time_s=3.0, slippery=True)
    assert kept.at_rest
    assert abs(kept.poses[0].position[0]) < 0.02
    assert slid.poses[0].position[0] > 0.1
