import numpy as np
import trimesh

from schemas.geometry import TriangleMesh
from tableverse_factory.bench.completion import HOLLOW_SHARE, cavity_of, height_field_of, score
from tableverse_factory.geometry.meshes import from_trimesh, to_trimesh


def cup(wall: float = 0.004) -> TriangleMesh:
    outline = [(0, 0), (0.04, 0), (0.04, 0.08), (0.04 - wall, 0.08), (0.04 - wall, wall), (0, wall)]
    return from_trimesh(trimesh.creation.revolve(np.array(outline), sections=48))


def test_a_cup_is_hollow_and_a_ring_or_an_upturned_cup_is_not():
    upturned = TriangleMesh(cup().vertices * [1.0, 1.0, -1.0] + [0.0, 0.0, 0.08], cup().faces[:, ::-1])
    ring = from_trimesh(trimesh.creation.annulus(0.036, 0.04, 0.03))
    assert cavity_of(cup()).share > 0.5
    assert cavity_of(upturned).share < HOLLOW_SHARE
    assert cavity_of(ring).share < HOLLOW_SHARE


def test_overlap_of_boxes_is_the_analytic_one():
    box = trimesh.creation.box((0.1, 0.06, 0.04))
    moved = box.copy()
    moved.apply_translation((0.02, 0.0, 0.0))
    found = score("box", 0, "moved", from_trimesh(box), from_trimesh(moved))
    assert abs(found.iou - 0.08 / 0.12) < 0.02


def test_a_height_field_fills_all_below_the_points():
    x, y = np.meshgrid(np.linspace(0.0, 0.1, 101), np.linspace(0.0, 0.06, 61))
    field = to_trimesh(height_field_of(np.stack([x, y, np.full_like(x, 0.05)], axis=-1).reshape(-1, 3)))
    assert field.is_watertight
    assert abs(field.volume / (0.1 * 0.06 * 0.05) - 1.0) < 0.08
