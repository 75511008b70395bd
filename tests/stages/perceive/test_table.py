"""The table frame and the choice of the table, on pictures whose truth is known."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy import ndimage

from schemas.config import Config
from schemas.manifest import ImageRow, SceneKind
from schemas.outcome import Done, Dropped
from tableverse_factory.geometry.math.camera import backproject
from tableverse_factory.geometry.math.transforms import rotation_angle, rotation_matrix, transform_points
from tableverse_factory.models.services import Services
from tableverse_factory.stages.observe.observe import observe
from tableverse_factory.stages.perceive.perceive import perceive
from tableverse_factory.stages.perceive.table import _remove_strips, find_table
from tableverse_factory.stages.perceive.table_refit import refit_table_to_box
from tests.helpers.tabletop_views import CAMERA, GEOMETRIC, SMALL_CAMERA, Box, best_overlaps, camera_above
from tests.helpers.tabletop_views import look as look_with

pytestmark = pytest.mark.heavy
look = partial(look_with, camera=SMALL_CAMERA)

THINGS = (Box(-0.12, 0.05, (0.1, 0.06, 0.15)), Box(0.15, -0.05, (0.08, 0.08, 0.08)))


def turn_camera(camera, degrees):
    """The camera turned about the table's y."""
    half = np.deg2rad(degrees) / 2
    w, x, y, z = camera.quaternion_wxyz
    cos, sin = np.cos(half), np.sin(half)
    turned = np.array([cos * w - sin * y, cos * x + sin * z, cos * y + sin * w, cos * z - sin * x])
    return replace(camera, quaternion_wxyz=turned)


def seen(observation, tmp_path):
    outcome = perceive(observation, GEOMETRIC, np.random.default_rng(0), Services(tmp_path))
    assert isinstance(outcome, Done), outcome
    return outcome.value


def test_the_table_frame_is_the_true_one_up_to_its_origin(tmp_path):
    camera = camera_above()
    observation, _ = look(THINGS, camera)
    found = seen(observation, tmp_path)
    assert rotation_angle(found.camera_to_table.quaternion_wxyz, camera.quaternion_wxyz) < 1e-3
    assert found.camera_to_table.position[2] == pytest.approx(camera.position[2], abs=5e-4)
    points = transform_points(found.camera_to_table, np.vstack([o.points_camera for o in found.objects]))
    middle = (points[:, :2].min(axis=0) + points[:, :2].max(axis=0)) / 2
    assert np.abs(middle).max() < 0.03, "the origin lies under the middle of the objects"
    assert found.table.rms_m < 1e-3


@pytest.mark.parametrize(
    "pitch", [20.0, 90.0, *(pytest.param(pitch, marks=pytest.mark.slow) for pitch in (45.0, 80.0))]
)
def test_x_is_the_cameras_right_and_y_leads_away_at_every_pitch(tmp_path, pitch):
    radius = 0.75
    height = radius * np.sin(np.deg2rad(pitch))
    observation, _ = look(THINGS, camera_above(height, radius * np.cos(np.deg2rad(pitch)), pitch))
    pose = seen(observation, tmp_path).camera_to_table
    matrix = rotation_matrix(pose.quaternion_wxyz)
    np.testing.assert_allclose(matrix @ [1, 0, 0], [1, 0, 0], atol=2e-3)  # the picture's right
    assert (matrix @ [0, -1, 0])[1] >= -1e-3, "up in the picture is away along the table, or up"
    assert (matrix @ [0, 0, 1])[2] < 0, "the camera looks down"
    assert pose.position[2] == pytest.approx(height, abs=2e-3)


def test_the_rectangle_is_the_table_and_covers_every_object(tmp_path):
    observation, _ = look(THINGS, camera_above(0.9, 0.7, 52.0), table_half=(0.35, 0.25), camera=CAMERA)
    found = seen(observation, tmp_path)
    assert sorted(found.table.half_size_xy) == pytest.approx([0.25, 0.35], abs=0.01)
    assert found.table.color == pytest.approx((180, 150, 120), abs=8)
    yaw = found.table.yaw
    axes = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    for item in found.objects:
        xy = transform_points(found.camera_to_table, item.points_camera)[:, :2]
        assert (np.abs((xy - found.table.center_xy) @ axes.T) <= found.table.half_size_xy).all()


def test_a_small_table_wins_over_the_larger_floor_below(tmp_path):
    observation, _ = look(THINGS, camera_above(0.8, 0.9, 40.0), table_half=(0.3, 0.2), floor_z=-0.45)
    found = seen(observation, tmp_path)
    assert found.camera_to_table.position[2] == pytest.approx(0.8, abs=3e-3)
    assert len(found.objects) == 2


@pytest.mark.parametrize("lean_deg", [0.0, 6.0])
def test_a_small_leaning_desk_wins_over_floor_and_chair(tmp_path, lean_deg):
    """A desk of 0.28 m by 0.2 m, the camera turned by its lean against the floor; a wider seat is lower and empty."""
    things = (Box(-0.06, 0.02, (0.07, 0.05, 0.12)), Box(0.08, -0.02, (0.06, 0.06, 0.06)))
    camera = camera_above(0.6, 0.6, 42.0)
    observation, _ = look(things, camera, noise_m=0.001, table_half=(0.14, 0.1))
    turned = turn_camera(camera, lean_deg)
    seat = Box(0.55, 0.5, (0.42, 0.42, 0.03), z=-0.3, color=(90, 30, 30))
    below, _ = look((seat,), turned, noise_m=0.001, seed=1, table_half=(0, 0), floor_z=-0.65)
    empty = observation.depth == 0
    picture = replace(
        observation,
        depth=np.where(empty, below.depth, observation.depth),
        color=np.where(empty[..., None], below.color, observation.color),
    )
    found = seen(picture, tmp_path)
    assert found.camera_to_table.position[2] == pytest.approx(0.6, abs=3e-3)
    assert len(found.objects) == len(things)


def test_a_pile_that_hides_the_middle_of_the_table_loses_nothing_beyond_it(tmp_path):
    """The right part of the table-top is less than a third of the left, and 0.3 m from it."""
    rows = enumerate((-0.3, -0.1, 0.1, 0.3))
    pile = [Box(0.22, y, (0.3, 0.2, 0.07 + 0.05 * (k % 2)), color=(200, 40 + 50 * k, 40)) for k, y in rows]
    beyond = Box(0.44, 0.0, (0.08, 0.08, 0.1), color=(40, 80, 200))
    things = [*pile, beyond, Box(-0.25, 0.0, (0.08, 0.08, 0.1))]
    observation, truth = look(things, camera_above(0.9, 0.7, 52.0), noise_m=0.001, table_half=(0.5, 0.4))
    found = seen(observation, tmp_path)
    assert best_overlaps(truth, found.instance_ids)[4] > 0.9, "the box beyond the pile"
    assert len(found.objects) == len(things)


def test_the_flat_top_of_a_box_is_no_table(tmp_path):
    crate = Box(0.0, 0.1, (0.4, 0.3, 0.2))
    observation, _ = look([crate, Box(0.0, 0.1, (0.08, 0.08, 0.1), z=0.2, color=(20, 160, 40))])
    found = seen(observation, tmp_path)
    assert found.camera_to_table.position[2] == pytest.approx(0.6, abs=3e-3)
    assert len(found.objects) == 2


def test_a_wall_behind_is_neither_table_nor_object(tmp_path):
    observation, truth = look(THINGS, camera_above(0.6, 0.7, 30.0), wall_y=0.45)
    found = seen(observation, tmp_path)
    assert found.camera_to_table.position[2] == pytest.approx(0.6, abs=3e-3)
    assert len(found.objects) == 2
    assert (truth[found.instance_ids > 0] > 1).mean() > 0.98


@pytest.mark.parametrize("height_m", [0.15, pytest.param(0.25, marks=pytest.mark.slow)])
def test_a_rail_on_a_wall_over_the_tables_edge_is_no_object(tmp_path, height_m):
    wall = Box(0.51, 0.2, (0.1, 1.4, 0.7), color=(240, 240, 240))
    rail = Box(0.435, 0.25, (0.05, 0.5, 0.05), z=height_m, color=(90, 90, 90))
    on_table = Box(-0.1, 0.0, (0.1, 0.1, 0.1))
    observation, truth = look(
        [on_table, rail, wall], camera_above(0.9, 0.8, 42.0), noise_m=0.001, table_half=(0.46, 0.5)
    )
    found = seen(observation, tmp_path)
    assert len(found.objects) == 1
    assert best_overlaps(truth, found.instance_ids)[0] > 0.9


def test_a_wall_alone_is_no_table():
    observation, _ = look([], camera_above(0.6, 0.7, 5.0), table_half=(0, 0), wall_y=0.6)
    outcome = find_table(observation, np.random.default_rng(0))
    if not isinstance(outcome, Dropped):  # a picture of nothing but a wall looks like a table from straight above
        assert abs(outcome.plane.normal[1]) < 0.1
    tilted, _ = look([], camera_above(0.6, 0.7, 40.0), table_half=(0, 0), wall_y=0.9)
    refused = find_table(tilted, np.random.default_rng(0))
    assert isinstance(refused, Dropped)
    assert refused.reason == "no_table_plane"
    assert "a wall or side" in refused.detail


def test_no_plane_and_no_objects_are_dropped_with_what_was_measured(tmp_path):
    observation, _ = look([])
    empty = perceive(observation, GEOMETRIC, np.random.default_rng(0), Services(tmp_path))
    assert isinstance(empty, Dropped)
    assert empty.reason == "no_objects"
    assert "geometric" in empty.detail
    noise = np.random.default_rng(0).uniform(0.4, 4.0, observation.depth.shape).astype(np.float32)
    nothing = perceive(replace(observation, depth=noise), GEOMETRIC, np.random.default_rng(0), Services(tmp_path))
    assert isinstance(nothing, Dropped)
    assert nothing.reason == "no_table_plane"


def test_a_single_reading_is_no_table(tmp_path):
    observation, _ = look(THINGS)
    depth = np.zeros_like(observation.depth)
    depth[100, 100] = 1.0
    outcome = perceive(replace(observation, depth=depth), GEOMETRIC, np.random.default_rng(0), Services(tmp_path))
    assert isinstance(outcome, Dropped)
    assert outcome.reason == "no_table_plane"


def bent(observation, seed, share=0.01):
    """Depth as a model gives it: a wrong scale, large patches too near or too far, and that is known."""
    rng = np.random.default_rng(seed)
    nodes = rng.standard_normal((5, 5))
    patches = ndimage.zoom(nodes, (480 / 5, 640 / 5), order=3, mode="nearest", grid_mode=True)
    scale = 1 + rng.normal(0.0, 0.05)
    depth = observation.depth * scale * (1 + share * patches / patches.std())
    return replace(observation, depth=depth.astype(np.float32), bend=0.015), scale


def errors(observation, camera, scale):
    """Of gravity [°], and of the camera's height over the table for its scale [m]."""
    view = find_table(observation, np.random.default_rng(0))
    assert not isinstance(view, Dropped), view
    up = rotation_matrix(camera.quaternion_wxyz)[2]
    angle = np.degrees(np.arccos(np.clip(view.plane.normal @ up, -1, 1)))
    return angle, abs(-view.plane.offset / scale - camera.position[2])


FLOORS = [(0.8, 0.9, 40.0, -0.45), (1.0, 1.1, 40.0, -0.72), (0.9, 1.3, 35.0, -0.72), (1.2, 1.0, 50.0, -0.7)]


@pytest.mark.slow  # many bends
def test_gravity_of_a_bent_picture_is_that_of_table_and_floor_together():
    angles = []
    for height, distance, pitch, floor in FLOORS:
        camera = camera_above(height, distance, pitch)
        observation, _ = look_with(THINGS, camera, noise_m=0.001, table_half=(0.3, 0.2), floor_z=floor)
        for seed in range(2):
            picture, scale = bent(observation, seed)
            angle, off = errors(picture, camera, scale)
            assert off < 0.1, "the table, not the floor"
            angles.append(angle)
        assert errors(observation, camera, 1.0)[0] < 0.1, "a sensor's table needs no floor"
    assert np.median(angles) < 0.9, "0.9 by the table alone"
    assert np.max(angles) < 1.5


def test_a_shelf_over_the_table_is_not_taken_for_it():
    shelf = Box(0.0, 0.42, (0.8, 0.25, 0.02), z=0.35)
    camera = camera_above(0.6, 0.8, 35.0)
    observation, _ = look([*THINGS, shelf], camera, noise_m=0.001)
    assert errors(observation, camera, 1.0)[1] < 0.005


def test_a_box_of_the_table_finds_a_low_one_over_a_larger_floor_and_a_wrong_box_changes_nothing():
    camera = camera_above(0.9, 1.3, 40.0)
    observation, truth = look(THINGS, camera, noise_m=0.001, table_half=(0.3, 0.2), floor_z=-0.2)
    first = find_table(observation, np.random.default_rng(0))
    assert -first.plane.offset == pytest.approx(1.1, abs=0.01), (
        "lower than tables are: it looks like a step of the floor"
    )
    rows, columns = np.nonzero(truth == 1)
    box = tuple(float(edge) for edge in (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1))
    told = refit_table_to_box(first, box, np.random.default_rng(0))
    assert -told.plane.offset == pytest.approx(0.9, abs=0.005)
    assert refit_table_to_box(told, box, np.random.default_rng(0)) is told
    for wrong in ((0.0, 0.0, 3.0, 3.0), (-50.0, 900.0, -20.0, 990.0), (0.0, 0.0, 320.0, 30.0)):
        assert refit_table_to_box(told, wrong, np.random.default_rng(0)).plane.offset == pytest.approx(
            told.plane.offset, abs=0.005
        )


def test_the_table_that_the_net_sees_is_taken_where_depth_alone_takes_its_floor(tmp_path):
    camera = camera_above(0.7, 0.8, 45.0)
    observation, _ = look(THINGS, camera, noise_m=0.001, table_half=(0.35, 0.25), floor_z=-0.15)
    by_depth = find_table(observation, np.random.default_rng(0))
    assert -by_depth.plane.offset == pytest.approx(0.85, abs=0.01)
    outcome = perceive(observation, Config(), np.random.default_rng(0), Services(tmp_path))
    assert isinstance(outcome, Done)
    assert outcome.value.camera_to_table.position[2] == pytest.approx(0.7, abs=0.005)
    assert len(outcome.value.objects) == len(THINGS), "the table-top is none"


@pytest.mark.shared
@pytest.mark.parametrize(
    ("name", "height"),
    [
        ("uoc_000005", 0.455),
        ("ycbv_000003", 0.666),
        *(
            pytest.param(*its, marks=pytest.mark.slow)
            for its in (("osd_test55", 0.590), ("ycbv_000002", 0.537), ("ycbv_000004", 0.714))
        ),
    ],
)
def test_the_table_of_real_captures_does_not_depend_on_the_seed(shared_dir, name, height):
    row = ImageRow(scene_id=name, kind=SceneKind.CAPTURE, uri=str(shared_dir / "captures" / name))
    observation = observe(row, Config(), np.random.default_rng(0), Services(shared_dir)).value
    for seed in range(2):
        view = find_table(observation, np.random.default_rng(seed))
        assert -view.plane.offset == pytest.approx(height, abs=0.004)


def test_strips_wider_than_the_picture_cost_no_more_than_the_picture():
    """The focal length of a file may be a million pixels, and the depth of a net a micrometre."""
    flat = np.ones((40, 50), dtype=bool)
    assert _remove_strips(flat, 1e15).all()
    flat[20] = False
    for wide in (10.0, 30.0, 60.0, 1e15):
        assert _remove_strips(flat, wide).any() == (wide < 16.0), "nineteen rows are left on each side"


def test_what_lies_in_the_plane_beside_the_table_top_does_not_tilt_it():
    pose = camera_above()
    observation, ids = look([], pose, noise_m=0.001)
    points = backproject(observation.depth, observation.camera)
    beside = (ids == 1) & (points[..., 0] > 0.05)
    depth = np.where(beside, observation.depth * 0.985, observation.depth).astype(np.float32)  # a mat of a centimetre
    bent = replace(observation, depth=depth, bend=0.01)
    top = (ids == 1) & ~beside
    true = rotation_matrix(pose.quaternion_wxyz)[2]
    angles = []
    for table_top in (top, None):
        view = find_table(bent, np.random.default_rng(0), table_top)
        assert not isinstance(view, Dropped), view
        angles.append(np.degrees(np.arccos(np.clip(view.plane.normal @ true, -1.0, 1.0))))
    assert angles[0] < 0.3 < angles[1]
