"""Antipodal grasps against bodies of which the truth is known."""

import numpy as np
import pytest
import trimesh

from schemas.config import TrajectoriesConfig
from schemas.geometry import TriangleMesh
from tableverse_factory.geometry.mesh.meshes import from_trimesh, read_mesh
from tableverse_factory.geometry.relations.antipodal import FRICTION, sample_inward_normals
from tableverse_factory.robotics.grasps.antipodal import OPENING_MARGIN_M, sample_antipodal_grasps
from tableverse_factory.robotics.grasps.clearance import find_clear_grasps
from tests.helpers.simple_bodies import box, cup, middle, standing

CONFIG = TrajectoriesConfig()


def grasps_on(mesh, arm, seed=0, felt=None, **config):
    options = CONFIG.model_copy(update=config)
    return sample_antipodal_grasps(
        mesh, felt or mesh, arm.shape, arm.max_opening_m, middle(mesh), options, np.random.default_rng(seed)
    )


def every_body():
    return {
        "box": box(0.05, 0.03, 0.12),
        "sphere": standing(trimesh.creation.icosphere(subdivisions=4, radius=0.03)),
        "cylinder": standing(trimesh.creation.cylinder(radius=0.03, height=0.1, sections=64)),
        "bar": box(0.2, 0.015, 0.01),
        "cup": cup(),
    }


@pytest.mark.parametrize("name", every_body())
def test_every_grasp_is_a_gripper_within_its_opening_above_the_table(arm, name):
    found = grasps_on(every_body()[name], arm)
    assert len(found) > 50
    gram = np.einsum("nji,njk->nik", found.rotations, found.rotations)
    assert np.abs(gram - np.eye(3)).max() < 1e-9
    assert np.linalg.det(found.rotations).min() > 0.0
    assert 0.0 < found.widths.min() <= found.widths.max() <= arm.max_opening_m - OPENING_MARGIN_M
    assert 0.0 <= found.scores.min() <= found.scores.max() <= 1.0
    assert (np.diff(found.scores) <= 0.0).all()
    assert found.rotations[:, 2, 2].max() < 1e-9, "an approach from below"


def test_a_box_is_held_by_opposite_faces(arm):
    size = np.array([0.05, 0.03, 0.12])
    mesh = box(*size)
    found = grasps_on(mesh, arm)
    axis = found.rotations[:, :, 1]
    along = np.abs(axis).argmax(axis=1)
    assert (np.abs(axis).max(axis=1) >= 1.0 / np.sqrt(1.0 + FRICTION**2) - 1e-9).all()
    assert (found.widths >= size[along] - 1e-6).all()
    best = found.select(np.arange(20, dtype=np.int32))
    assert np.abs(best.rotations[:, :, 1]).max(axis=1).min() > 0.99
    assert np.abs(best.widths - size[along[:20]]).max() < 1e-3
    assert np.abs(best.positions - middle(mesh))[:, :2].max() < 0.03


def test_what_is_wider_than_the_opening_is_not_held_across(arm):
    assert len(grasps_on(box(0.1, 0.1, 0.1), arm)) == 0
    wide = grasps_on(box(0.1, 0.04, 0.1), arm)
    assert np.abs(wide.rotations[:, 1, 1]).min() > 0.8, "only across the narrow side"


def test_a_sphere_is_held_through_its_centre(arm):
    found = grasps_on(standing(trimesh.creation.icosphere(subdivisions=4, radius=0.03)), arm)
    best = found.select(np.arange(10, dtype=np.int32))
    assert np.abs(best.widths - 0.06).max() < 0.003
    assert np.linalg.norm(best.positions - [0.0, 0.0, 0.03], axis=1).max() < 0.012


def test_a_cup_is_pinched_at_its_wall_and_enclosed(arm):
    found = grasps_on(cup(radius=0.03), arm)
    assert (np.abs(found.widths - 0.004) < 0.002).any()
    assert (np.abs(found.widths - 0.06) < 0.006).any()


def test_a_body_inside_out_is_held_like_the_body(arm):
    mesh = box(0.05, 0.03, 0.12)
    turned = TriangleMesh(mesh.vertices, np.ascontiguousarray(mesh.faces[:, ::-1]))
    assert len(grasps_on(turned, arm)) > 50


def test_the_middle_is_better_than_the_end(arm):
    rod = box(0.3, 0.02, 0.03)
    found = grasps_on(rod, arm)
    best = found.select(np.arange(10, dtype=np.int32))
    assert np.abs(best.positions[:, 0]).max() < 0.03
    assert np.abs(found.positions[:, 0]).max() > 0.1, "but the ends are kept, for when the middle is taken"


def test_thin_things_that_lie_flat_can_be_picked_up(arm):
    handle = box(0.18, 0.012, 0.008)
    found = grasps_on(handle, arm)
    own, _ = sample_inward_normals(handle, 1000)
    assert find_clear_grasps(found, arm.shape, arm.max_opening_m, own, []).sum() > 30


def test_the_same_seed_gives_the_same_bytes(arm):
    mesh = cup()
    one, same = grasps_on(mesh, arm, 3), grasps_on(mesh, arm, 3)
    for field in ("rotations", "positions", "widths", "scores"):
        assert getattr(one, field).tobytes() == getattr(same, field).tobytes()


def test_a_plate_that_lies_flat_offers_nothing(arm):
    assert len(grasps_on(box(0.12, 0.12, 0.008), arm)) == 0


@pytest.mark.parametrize("count", [16, 100])
def test_few_candidates_are_no_error(arm, count):
    assert grasps_on(cup(), arm, candidates=count).scores.ndim == 1


@pytest.mark.shared
def test_a_scan_of_many_faces_has_grasps(arm, shared_dir):
    data = (shared_dir / "meshes" / "004_sugar_box.obj").read_bytes()
    mesh = read_mesh(data, "004_sugar_box.obj")
    mesh = TriangleMesh(mesh.vertices - [0.0, 0.0, mesh.vertices[:, 2].min()], mesh.faces)
    pieces = from_trimesh(trimesh.convex.convex_hull(mesh.vertices))
    assert len(mesh.faces) > 15_000
    assert len(grasps_on(mesh, arm, felt=pieces)) > 50
