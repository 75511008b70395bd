"""Pictures in which only some parts are cast again are those that a whole rendering of the same moment gives."""

import numpy as np
import pytest

from schemas.geometry import Camera, Pose
from tableverse_factory.delivery.episodes.incremental_renderer import IncrementalRenderer, PaintedMeshes
from tableverse_factory.geometry.math.camera import PosedCamera, project
from tableverse_factory.geometry.math.transforms import (
    invert_pose,
    quaternion_from_rotation_vector,
    transform_points,
)
from tableverse_factory.physics.mjcf.scenery import make_box_mesh
from tableverse_factory.physics.render.render import render
from tests.helpers.recorded_dataset import EYE, GREEN, RED, painted_box

CAMERA = Camera(150.0, 150.0, 79.5, 59.5, 160, 120)
TABLE = make_box_mesh(np.array([0.4, 0.3, 0.01]))
MUG, BLOCK = painted_box((0.08, 0.08, 0.08), RED), painted_box((0.05, 0.05, 0.12), GREEN)
STILL = PaintedMeshes((MUG, TABLE), (None, (190.0, 170.0, 150.0)))
TURNED = Pose(np.array([0.12, 0.05, 0.2]), quaternion_from_rotation_vector(np.array([0.4, -0.3, 0.9])))
HIDDEN = Pose(np.array([0.0, 0.05, -0.09]), quaternion_from_rotation_vector(np.zeros(3)))


@pytest.fixture(scope="module")
def pictures() -> IncrementalRenderer:
    return IncrementalRenderer(STILL, PaintedMeshes((BLOCK,), (None,)), PosedCamera(CAMERA, EYE))


def whole(pose: Pose) -> np.ndarray:
    moved = painted_box((0.05, 0.05, 0.12), GREEN)
    placed = type(moved)(transform_points(pose, moved.vertices), moved.faces, moved.vertex_colors)
    parts, paints = [*STILL.meshes, placed], [*STILL.paints, None]
    return render(parts, CAMERA, EYE, paints=paints, sky_rays=6, samples=2).color


@pytest.mark.heavy
def test_a_frame_looks_like_the_whole_scene_rendered(pictures):
    frame, truth = pictures.render([TURNED]).astype(int), whole(TURNED).astype(int)
    off = np.abs(frame - truth).max(axis=2)
    assert np.median(off) <= 2
    assert (off > 40).mean() < 0.01  # the edges of shadows are softened in another way


def test_a_part_is_seen_where_the_camera_projects_it(pictures):
    x, y = np.rint(project(transform_points(invert_pose(EYE), TURNED.position[None]), CAMERA)[0]).astype(int)
    pixel = pictures.render([TURNED])[y, x].astype(int)
    assert pixel[1] > pixel[0] + 40


def test_what_stands_in_front_hides_what_moves(pictures):
    frame = pictures.render([HIDDEN]).astype(int)
    assert not (frame[..., 1] > frame[..., 0] + 40).any()


def test_what_moves_throws_its_shadow_on_the_table(pictures):
    lit, shadowed = pictures.render([HIDDEN]).astype(int), pictures.render([TURNED]).astype(int)
    table = (lit.min(axis=2) > 100) & (np.abs(lit - shadowed).max(axis=2) > 20)
    green = shadowed[..., 1] > shadowed[..., 0] + 30
    assert (table & ~green).sum() > 30
    assert (shadowed[table & ~green] < lit[table & ~green]).all()


def test_frames_do_not_depend_on_those_before(pictures):
    first = pictures.render([TURNED])
    pictures.render([HIDDEN])
    assert (pictures.render([TURNED]) == first).all()


@pytest.mark.parametrize("z", [0.45, 0.46, 2.0, -3.0])
def test_a_part_at_or_behind_the_eye_is_no_error(pictures, z):
    direction = EYE.position / np.linalg.norm(EYE.position)
    pose = Pose(EYE.position + direction * (z - 0.45), TURNED.quaternion_wxyz)
    assert pictures.render([pose]).shape == (120, 160, 3)
