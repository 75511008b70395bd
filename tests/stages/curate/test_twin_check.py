"""Agreement of a twin with its photograph: what it costs a scene, whatever a judge says."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from schemas.config import Config, CurateConfig
from schemas.geometry import Pose
from schemas.objects import Evidence, Explanation
from schemas.outcome import Done
from tableverse_factory.core.png import encode_png
from tableverse_factory.geometry.math.transforms import (
    multiply_quaternions,
    quaternion_from_rotation_vector,
    transform_points,
)
from tableverse_factory.geometry.mesh.meshes import box_center, place_mesh
from tableverse_factory.geometry.relations.misfit import MISFIT_SHARE
from tableverse_factory.models.services import Services
from tableverse_factory.physics.render.render import look_at, render
from tableverse_factory.stages.curate.curate import curate
from tableverse_factory.stages.curate.judge_input import build_judge_input
from tableverse_factory.stages.curate.twin_check import TwinCheck
from tests.helpers.curate_scenes import kitchen
from tests.helpers.tabletop_views import CAMERA

EYE = look_at(np.array([0.0, -0.9, 0.9]), np.zeros(3))


def photographed(scene, explained=1.0):
    """The scene with masks that are exactly what the camera sees of it."""
    placed = scene.rectified.placed
    meshes = [place_mesh(o.mesh, pose, o.scale) for o, pose in zip(placed.objects, scene.poses, strict=True)]
    masks = encode_png((render(meshes, CAMERA, EYE, shadows=False).ids + 1).astype(np.uint16))
    numbers = tuple(range(1, len(meshes) + 1))
    evidence = Evidence(b"", masks, numbers, CAMERA, EYE)
    shares = ((placed.objects[0].object_id, round(1000 * explained), explained),)
    return with_placed(scene, evidence=evidence, explanation=Explanation(1000, 1.0, shares))


def with_placed(scene, **changes):
    rectified = scene.rectified
    return replace(scene, rectified=replace(rectified, placed=replace(rectified.placed, **changes)))


def moved(scene, index, shift=(0.0, 0.0, 0.0), turn=(0.0, 0.0, 0.0)):
    poses = list(scene.poses)
    before = poses[index]
    turned = multiply_quaternions(quaternion_from_rotation_vector(np.array(turn)), before.quaternion_wxyz)
    poses[index] = Pose(before.position + np.array(shift), turned)
    return replace(scene, poses=tuple(poses))


def verdict(scene):
    outcome = curate(scene, Config(), np.random.default_rng(0), Services(Path("unused")))
    assert isinstance(outcome, Done)
    return outcome.value


def check(scene):
    return build_judge_input(scene, CurateConfig()).twin


def test_a_scene_that_is_as_photographed_loses_nothing():
    curated = verdict(photographed(kitchen()))
    plain = verdict(kitchen())
    assert curated.coverage.whole == 1.0
    assert set(curated.coverage.of_objects) == {1.0}
    assert curated.assessment == plain.assessment
    assert plain.coverage is None


@pytest.mark.parametrize(("explained", "codes"), [(0.95, ()), (0.8, ("LITTLE_EXPLAINED",))])
def test_what_is_left_unexplained_makes_a_scene_unusable(explained, codes):
    found = verdict(photographed(kitchen(), explained)).assessment
    assert found.reason_codes == codes
    assert found.usable == (not codes)
    assert found.quality_score <= (4 if codes else 10)
    assert ("gate_overruled" in {remark.code for remark in found.remarks}) == bool(codes)


def test_things_that_moved_away_cover_less_and_cost_points():
    scene = photographed(kitchen())
    whole, one = check(scene), check(moved(scene, 0, (0.0, 0.0, 3.0)))
    assert one.covered < whole.covered == 1.0
    assert one.coverage.of_objects[0] == 0.0
    assert one.most_points < whole.most_points == 10
    assert (whole.n_lost, one.n_lost) == (0, 1)
    assert (whole.n_poor, one.n_poor) == (0, 0), "what is lost counts once"


def test_things_that_the_twin_shows_elsewhere_cost_points_though_they_stayed():
    scene = photographed(kitchen())
    evidence = scene.rectified.placed.evidence
    assert evidence is not None
    first, second, *others = evidence.object_pixels
    swapped = check(with_placed(scene, evidence=replace(evidence, object_pixels=(second, first, *others))))
    assert (swapped.n_lost, swapped.n_poor, swapped.n_things) == (0, 2, 7)
    assert swapped.most_points <= int(1.5 + 9 * 5 / 7) < check(scene).most_points


@pytest.mark.parametrize(("far", "n_poor"), [(0.9, 0), (1.1, 1)])
def test_a_shape_far_from_what_was_read_costs_points(far, n_poor):
    scene = photographed(kitchen())
    placed = scene.rectified.placed
    first, *others = placed.objects
    assert placed.evidence is not None
    eye = placed.evidence.camera_to_table.position
    middle = transform_points(first.pose, box_center(first.mesh)[None], first.scale)[0]
    residual_m = far * MISFIT_SHARE * float(np.linalg.norm(middle - eye))
    answer = check(with_placed(scene, objects=(replace(first, fit_residual_m=residual_m), *others)))
    assert (answer.n_lost, answer.n_poor) == (0, n_poor)
    assert (answer.most_points < check(scene).most_points) == bool(n_poor)
    seen_nowhere = with_placed(scene, objects=(replace(first, fit_residual_m=residual_m), *others), evidence=None)
    assert check(seen_nowhere).n_poor == 0, "a layout has no readings"


def test_a_quarter_of_the_things_may_topple_slide_or_be_left_out():
    scene = kitchen()
    left_out = (("obj_901", "too few points"),)
    assert check(with_placed(scene, left_out=left_out)).n_things == check(scene).n_things + 1 == 8
    two = moved(moved(with_placed(scene, left_out=()), 5, (0.06, 0.0, 0.0)), 6, (0.0, 0.0, 0.0), (1.5, 0.0, 0.0))
    assert check(with_placed(scene, left_out=left_out)).reason_codes == ()
    assert check(two).n_lost == 2
    assert check(with_placed(two, left_out=left_out)).reason_codes == ("MANY_LOST",)


def test_points_follow_the_smaller_share():
    assert TwinCheck(0.5, None, 4, 0, 0).most_points == 6
    assert TwinCheck(None, None, 4, 0, 0).most_points == 10
    assert TwinCheck(1.0, None, 4, 1, 1).most_points == 6
