"""Rays against boxes: analytic intersections agree with ray casting, and misfits with what was rendered."""

from dataclasses import replace

import numpy as np
import pytest

from schemas.geometry import Pose
from tableverse_factory.geometry.math.transforms import normalize_quaternion, rotation_matrix
from tableverse_factory.stages.place.completion.box import SolidBox, build_box_mesh
from tableverse_factory.stages.place.completion.ray_misfit import (
    MISS_M,
    WORST_M,
    RaySample,
    compute_mesh_misfit,
    compute_misfit,
    intersect_box,
    intersect_rounded_box,
)


def make_rays(rng, own=40, past=60):
    """Rays from a camera above the origin: the object's first, then those that see the background behind it."""
    directions = np.vstack([rng.uniform(-0.15, 0.15, (2, own + past)), -np.ones(own + past)])
    end = np.concatenate([rng.uniform(0.8, 1.0, own), np.full(past, 1.2)])
    return RaySample(np.array([0.0, 0.0, 1.0]), directions, end, rng.uniform(0.3, 1.0, own))


def make_box(rng):
    pose = Pose(rng.uniform(-0.02, 0.02, 3), normalize_quaternion(rng.normal(size=4)))
    return SolidBox(pose, rng.uniform(0.02, 0.1, 3), 0.0)


@pytest.mark.parametrize("seed", range(8))
def test_a_box_has_the_misfit_of_its_mesh(seed):
    rng = np.random.default_rng(seed)
    rays, box = make_rays(rng), make_box(rng)
    hit = intersect_box(rays, box.pose.position, rotation_matrix(box.pose.quaternion_wxyz), box.half_size)
    assert (hit < MISS_M).any()
    assert (hit == MISS_M).any()
    assert compute_misfit(rays, hit) == pytest.approx(
        compute_mesh_misfit(rays, build_box_mesh(box), box.pose), abs=1e-6
    )


@pytest.mark.parametrize("share", [0.2, 0.8, 1.0])
def test_a_rounded_box_has_the_misfit_of_its_mesh(share):
    rng = np.random.default_rng(5)
    rays, box = make_rays(rng, own=200), make_box(rng)
    box = replace(box, radius=share * box.half_size[:2].min())
    rotation = rotation_matrix(box.pose.quaternion_wxyz)
    hit = intersect_rounded_box(rays, box.pose.position, rotation, box.half_size, box.radius)
    sharp = intersect_box(rays, box.pose.position, rotation, box.half_size)
    assert (sharp < hit).any(), "no ray passes a rounded edge"
    assert (hit >= sharp - 1e-9).all()
    assert compute_misfit(rays, hit) == pytest.approx(
        compute_mesh_misfit(rays, build_box_mesh(box), box.pose), abs=1e-4
    )


@pytest.mark.parametrize(("direction", "depth"), [([0, 0, -1], 0.95), ([0, 1, 0], 0.96), ([1, 0, 0], 0.95)])
def test_rays_along_the_faces_of_a_rounded_box_meet_it(direction, depth):
    ray = np.array(direction, dtype=np.float64)
    rays = RaySample(-ray, ray[:, None], np.array([depth]), np.array([1.0]))
    for radius in (0.0, 0.01, 0.04):
        hit = intersect_rounded_box(rays, np.zeros(3), np.eye(3), np.array([0.05, 0.04, 0.05]), radius)
        assert hit == pytest.approx([depth])


def test_rays_along_the_faces_of_a_box_meet_it():
    rays = RaySample(np.array([0.0, 0.0, 1.0]), np.array([[0.0], [0.0], [-1.0]]), np.array([0.9]), np.array([1.0]))
    hit = intersect_box(rays, np.zeros(3), np.eye(3), np.full(3, 0.1))
    assert hit == pytest.approx([0.9])
    assert compute_misfit(rays, hit) == pytest.approx(0.0, abs=1e-12)


def test_a_miss_costs_the_most_even_where_the_depth_is_unknown():
    rays = RaySample(np.zeros(3), np.zeros((3, 2)), np.array([0.0, 0.5]), np.array([0.0, 1.0]))
    assert compute_misfit(rays, np.array([MISS_M, MISS_M])) == pytest.approx(WORST_M)
    assert compute_misfit(rays, np.array([0.3, 0.5])) == 0.0


def test_a_shape_before_the_background_costs_and_one_behind_it_does_not():
    rays = RaySample(np.zeros(3), np.zeros((3, 3)), np.array([0.5, 1.0, 1.0]), np.array([1.0]))
    assert compute_misfit(rays, np.array([0.5, 0.8, 1.1])) == pytest.approx(WORST_M)
    assert compute_misfit(rays, np.array([0.5, 1.1, MISS_M])) == 0.0


@pytest.mark.parametrize(
    ("off_m", "cost_m"), [(0.01, 0.1 * 0.01**2 / 0.06), (0.03, 0.1 * 0.015), (-0.05, 0.1 * (0.05 - 0.015))]
)
def test_the_distance_of_estimated_depth_costs_by_its_square_up_to_three_per_cent_and_then_linearly(off_m, cost_m):
    rays = RaySample(np.zeros(3), np.zeros((3, 5)), np.ones(5), np.ones(5), estimated=True)
    assert compute_misfit(replace(rays, often_off_m=0.03), np.full(5, 1.0 - off_m)) == pytest.approx(cost_m)
    assert compute_misfit(rays, np.full(5, 1.0 - off_m)) == pytest.approx(0.1 * abs(off_m)), "of a sensor"


def test_an_error_of_the_relief_of_estimated_depth_costs_a_quarter():
    rays = RaySample(np.zeros(3), np.zeros((3, 5)), np.ones(5), np.ones(5), estimated=True)
    assert compute_misfit(rays, np.array([1.0, 1.0, 1.0, 1.0, 0.98])) == pytest.approx(0.25 * 0.02 / 5)


@pytest.mark.parametrize("count", [1, 2, 7, 8])
def test_the_relief_of_estimated_depth_is_measured_about_its_median(count):
    off = np.random.default_rng(count).uniform(-0.02, 0.02, count)
    rays = RaySample(np.zeros(3), np.zeros((3, count)), np.ones(count), np.ones(count), estimated=True)
    middle = np.median(off)
    cost = np.minimum(0.25 * np.abs(off - middle), 0.008).mean() + 0.1 * abs(middle)
    assert compute_misfit(rays, 1.0 - off) == pytest.approx(cost)
