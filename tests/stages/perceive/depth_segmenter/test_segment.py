"""What is told apart and what is kept whole, on pictures whose truth is known."""

from dataclasses import replace

import numpy as np
import pytest

from schemas.config import Config
from schemas.manifest import ImageRow, SceneKind
from schemas.outcome import Done
from tableverse_factory.models.services import Services
from tableverse_factory.stages.observe.observe import observe
from tableverse_factory.stages.perceive.base.interfaces import DetectionResult
from tableverse_factory.stages.perceive.depth_segmenter.segment import assign_regions_to_boxes, fill_holes
from tableverse_factory.stages.perceive.perceive import perceive
from tests.helpers.tabletop_views import GEOMETRIC, Bowl, Box, best_overlaps, camera_above, look

pytestmark = pytest.mark.heavy


def found_in(things, tmp_path, noise_m=0.0, **scene):
    observation, truth = look(things, noise_m=noise_m, **scene)
    outcome = perceive(observation, GEOMETRIC, np.random.default_rng(0), Services(tmp_path))
    assert isinstance(outcome, Done), outcome
    return outcome.value, truth


def assert_found(things, tmp_path, at_least=0.9, **scene):
    """Every thing once, nothing else."""
    found, truth = found_in(things, tmp_path, **scene)
    assert len(found.objects) == len(things)
    assert min(best_overlaps(truth, found.instance_ids)) >= at_least
    return found


@pytest.mark.parametrize("noise_m", [0.0015, pytest.param(0.0, marks=pytest.mark.slow)])
@pytest.mark.parametrize("yaw", [0.0, 0.5])
def test_a_box_with_three_visible_faces_is_one_object(tmp_path, noise_m, yaw):
    assert_found([Box(0.0, 0.0, (0.16, 0.1, 0.12), yaw=yaw)], tmp_path, noise_m=noise_m)


@pytest.mark.parametrize("noise_m", [0.0015, pytest.param(0.0, marks=pytest.mark.slow)])
def test_two_boxes_that_touch_are_two(tmp_path, noise_m):
    tall, low = Box(-0.05, 0.0, (0.1, 0.1, 0.16)), Box(0.06, 0.02, (0.12, 0.1, 0.07), color=(40, 160, 60))
    assert_found([tall, low], tmp_path, noise_m=noise_m)


@pytest.mark.parametrize("noise_m", [0.0015, pytest.param(0.0, marks=pytest.mark.slow)])
def test_a_box_stacked_on_another_is_cut_at_the_crease(tmp_path, noise_m):
    lower = Box(0.0, 0.0, (0.24, 0.18, 0.07))
    upper = Box(0.0, 0.01, (0.12, 0.09, 0.09), z=0.07, yaw=0.4, color=(40, 160, 60))
    assert_found([lower, upper], tmp_path, noise_m=noise_m)


@pytest.mark.parametrize("gap_m", [0.03, 0.06])
def test_two_boxes_of_one_height_behind_a_third_stay_two_where_one_is_seen_before_the_other(tmp_path, gap_m):
    """Their tops continue each other behind the third, but beside it the near one ends in a step."""
    near, far = Box(0.0, -0.1, (0.2, 0.2, 0.08)), Box(0.0, 0.12 + gap_m, (0.2, 0.24, 0.08), color=(40, 160, 60))
    assert_found([near, far, Box(0.0, -0.08, (0.1, 0.05, 0.12), z=0.08, color=(20, 20, 200))], tmp_path, noise_m=0.0015)


def test_things_of_one_colour_are_told_apart_by_shape_alone(tmp_path):
    gray = (150, 150, 150)
    assert_found(
        [Box(0.0, 0.0, (0.2, 0.16, 0.06), color=gray), Box(0.02, 0.0, (0.08, 0.08, 0.1), z=0.06, color=gray)], tmp_path
    )


def test_a_box_behind_another_is_one_object_although_two_parts_of_it_show(tmp_path):
    behind = Box(0.0, 0.12, (0.3, 0.06, 0.16))
    front = Box(0.0, -0.02, (0.08, 0.08, 0.22), color=(40, 160, 60))
    found, truth = found_in([behind, front], tmp_path)
    assert len(found.objects) == 2
    assert min(best_overlaps(truth, found.instance_ids)) > 0.9


def test_two_boxes_beside_each_other_with_the_table_between_stay_two(tmp_path):
    pair = [Box(-0.12, 0.1, (0.14, 0.08, 0.1)), Box(0.12, 0.1, (0.14, 0.08, 0.1))]
    assert_found([*pair, Box(0.0, -0.1, (0.05, 0.05, 0.06), color=(40, 160, 60))], tmp_path)


def test_a_bowl_is_one_object_with_its_inside_and_holds_what_lies_in_it(tmp_path):
    bowl, block = Bowl(0.0, 0.0, 0.09), Box(0.0, 0.01, (0.045, 0.045, 0.06), z=0.012, color=(230, 200, 40))
    found, truth = found_in([bowl, block], tmp_path, camera_to_table=camera_above(0.7, 0.5, 52.0))
    overlaps = best_overlaps(truth, found.instance_ids)
    assert overlaps[0] > 0.75, "wall, inside and floor of the bowl"
    assert overlaps[1] > 0.75, "the block"
    by_size = sorted(found.objects, key=lambda o: -len(o.points_camera))
    assert by_size[1].contained_in == by_size[0].object_id


def test_what_lies_on_a_box_is_not_in_it(tmp_path):
    found = assert_found(
        [Box(0.0, 0.0, (0.24, 0.18, 0.07)), Box(0.0, 0.0, (0.08, 0.08, 0.08), z=0.07, color=(40, 160, 60))], tmp_path
    )
    assert all(item.contained_in is None for item in found.objects)


def test_what_stands_beside_the_table_is_left_out(tmp_path):
    on, off = Box(0.0, 0.0, (0.1, 0.1, 0.12)), Box(0.55, 0.1, (0.14, 0.14, 0.6), z=-0.5, color=(40, 160, 60))
    found, truth = found_in([on, off], tmp_path, table_half=(0.4, 0.3), floor_z=-0.5)
    assert len(found.objects) == 1
    assert best_overlaps(truth, found.instance_ids)[0] > 0.9


def test_ids_are_dense_the_largest_first_and_repeat_exactly(tmp_path):
    things = [Box(-0.2, 0.0, (0.06, 0.06, 0.06)), Box(0.0, 0.0, (0.1, 0.1, 0.1)), Box(0.22, 0.0, (0.12, 0.12, 0.16))]
    first, _ = found_in(things, tmp_path, noise_m=0.001)
    second, _ = found_in(things, tmp_path, noise_m=0.001)
    assert [o.object_id for o in first.objects] == ["obj_000", "obj_001", "obj_002"]
    sizes = [int((first.instance_ids == o.instance_id).sum()) for o in first.objects]
    assert sizes == sorted(sizes, reverse=True)
    assert first.instance_ids.tobytes() == second.instance_ids.tobytes()
    for a, b in zip(first.objects, second.objects, strict=True):
        assert a.points_camera.tobytes() == b.points_camera.tobytes()


def test_points_lie_on_the_objects_true_surface(tmp_path):
    box = Box(0.0, 0.0, (0.16, 0.1, 0.12))
    observation, truth = look([box], noise_m=0.0)
    rng = np.random.default_rng(0)
    depth = np.array(observation.depth)
    rows, columns = np.nonzero(truth == 2)
    stray = rng.choice(len(rows), 60, replace=False)
    depth[rows[stray], columns[stray]] -= rng.uniform(0.05, 0.2, 60).astype(np.float32)
    outcome = perceive(replace(observation, depth=depth), GEOMETRIC, rng, Services(tmp_path))
    item = max(outcome.value.objects, key=lambda o: len(o.points_camera))
    z = item.points_camera[:, 2]
    surface = observation.depth[truth == 2]
    assert z.min() >= surface.min() - 0.01, "stray readings in front are gone"
    assert z.max() <= surface.max() + 0.01
    assert len(z) > 0.8 * len(surface)


def test_at_most_so_many_objects_as_configured(tmp_path):
    observation, _ = look([Box(x, 0.0, (0.07, 0.07, 0.07)) for x in (-0.2, 0.0, 0.2)])
    config = Config.model_validate({"perceive": {"max_objects": 2}})
    outcome = perceive(observation, config, np.random.default_rng(0), Services(tmp_path))
    assert len(outcome.value.objects) == 2
    ((name, reason),) = outcome.value.left_out
    assert name not in {item.object_id for item in outcome.value.objects}
    assert "max_objects" in reason


@pytest.mark.shared
@pytest.mark.parametrize(
    ("name", "count"),
    [
        ("grasp6d_cheezit", (1, 1)),
        pytest.param("grasp6d_red_mug", (1, 1), marks=pytest.mark.slow),
        pytest.param("uoc_000000", (9, 11), marks=pytest.mark.slow),
        ("ycbv_000002", (5, 6)),
    ],
)
def test_real_table_tops_hold_as_many_objects_as_one_counts(shared_dir, tmp_path, name, count):
    row = ImageRow(scene_id=name, kind=SceneKind.CAPTURE, uri=str(shared_dir / "captures" / name))
    observation = observe(row, Config(), np.random.default_rng(0), Services(tmp_path)).value
    outcome = perceive(observation, GEOMETRIC, np.random.default_rng(0), Services(tmp_path))
    assert count[0] <= len(outcome.value.objects) <= count[1]


def test_small_holes_close_only_within_one_object():
    ids = np.ones((30, 30), dtype=np.int32)
    ids[:, 15:] = 2
    ids[5:8, 5:8] = 0
    ids[20:22, 14:16] = 0
    ids[10:20, 20:29] = 0
    closed = fill_holes(ids)
    assert (closed[5:8, 5:8] == 1).all()
    assert (closed[20:22, 14:16] == 0).all(), "between two objects"
    assert (closed[10:20, 20:29] == 0).all(), "too large for a lost reading"


def test_no_boxes_have_no_regions():
    regions = np.array([[0, 1], [2, 2]], dtype=np.int32)
    assert not assign_regions_to_boxes(regions, DetectionResult(())).any()
