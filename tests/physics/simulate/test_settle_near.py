"""What topples from the pose that rectification gave it, and would hold from the one that was seen, is put back."""

from dataclasses import replace

import numpy as np
import pytest

from schemas.geometry import Pose
from tableverse_factory.geometry.math.transforms import quaternion_from_rotation_vector
from tableverse_factory.physics.mjcf.slab import fit_slab
from tableverse_factory.physics.mjcf.spec import SceneBody, make_scene_body, make_simulation_spec
from tableverse_factory.physics.simulate.certificate import find_deepest_contact
from tableverse_factory.physics.simulate.settle_bodies import bring_to_rest
from tableverse_factory.physics.simulate.settle_near import NEAR, STRAY, measure_deviation, settle_near
from tests.helpers.simple_scenes import TABLE, UPRIGHT, ball, box

SLAB = fit_slab(TABLE, [], [], [])
LIMITS = {"timestep_s": 0.002, "max_time_s": 6.0}


def tilted(degrees: float) -> np.ndarray:
    return quaternion_from_rotation_vector(np.array([0.0, np.radians(degrees), 0.0]))


def body(
    name: str, size: tuple[float, float, float], at: tuple[float, float, float], degrees: float = 0.0
) -> SceneBody:
    mesh = box(*size)
    return make_scene_body(name, mesh, (mesh,), 1.0, 0.2, Pose(np.array(at), tilted(degrees)))


FOOT = body("foot", (0.1, 0.1, 0.04), (-0.2, 0.0, 0.0202))
BOOK = replace(body("book", (0.02, 0.1, 0.16), (0.03, 0.0, 0.0885), 12.0), rolling_friction=0.001)
SEEN = {"foot": FOOT.pose, "book": Pose(np.array([0.026, 0.003, 0.083]), tilted(2.0))}


def test_what_toppled_stands_where_it_was_seen() -> None:
    fallen, _ = bring_to_rest((FOOT, BOOK), SLAB, **LIMITS, gentle=True)
    assert measure_deviation(fallen[1], SEEN) > STRAY
    (foot, book), rest = settle_near((FOOT, BOOK), SEEN, SLAB, **LIMITS)
    assert rest.at_rest
    assert measure_deviation(book, SEEN) < NEAR
    assert measure_deviation(foot, SEEN) < 0.1
    model = make_simulation_spec((foot, book), SLAB).compile()
    assert find_deepest_contact(model, [foot.pose, book.pose])[0] < 1e-4


def test_what_was_seen_inside_another_is_put_on_it() -> None:
    """A ball beside a block, seen with a tenth of it inside the block's top."""
    mesh = ball(0.02)
    marble = make_scene_body("marble", mesh, (mesh,), 1.0, 0.05, Pose(np.array([-0.12, 0.0, 0.021]), UPRIGHT))
    marble = replace(marble, rolling_friction=0.005)
    seen = {"foot": FOOT.pose, "marble": Pose(np.array([-0.2, 0.0, 0.056]), UPRIGHT)}
    (_, ended), rest = settle_near((FOOT, marble), seen, SLAB, **LIMITS)
    assert rest.at_rest
    np.testing.assert_allclose(ended.pose.position, [-0.2, 0.0, 0.06], atol=0.004)


@pytest.mark.parametrize("seen", [{}, {"foot": FOOT.pose}, {"book": Pose(np.array([0.03, 0.0, 1.0]), tilted(0.0))}])
def test_without_a_pose_that_holds_nothing_changes(seen: dict[str, Pose]) -> None:
    fallen, rest = bring_to_rest((FOOT, BOOK), SLAB, **LIMITS, gentle=True)
    near, again = settle_near((FOOT, BOOK), seen, SLAB, **LIMITS)
    for one, other in zip(fallen, near, strict=True):
        np.testing.assert_array_equal(one.pose.position, other.pose.position)
        np.testing.assert_array_equal(one.pose.quaternion_wxyz, other.pose.quaternion_wxyz)
    assert rest.time_s == again.time_s


def test_the_same_bodies_end_the_same() -> None:
    first, second = (settle_near((FOOT, BOOK), SEEN, SLAB, **LIMITS)[0] for _ in range(2))
    for one, other in zip(first, second, strict=True):
        np.testing.assert_array_equal(one.pose.position, other.pose.position)
        np.testing.assert_array_equal(one.pose.quaternion_wxyz, other.pose.quaternion_wxyz)
