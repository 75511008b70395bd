"""By how much an object must be turned about the vertical to lie as the true one does, symmetric shapes included."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.spatial import cKDTree

from schemas.geometry import Frozen, Points, Quaternion, TriangleMesh
from tableverse_factory.geometry.samples import surface_samples

DENSE, SPARSE = 6000, 300
"""Points that stand for a surface, and those of the other whose distance to it is asked: never the same points, or the
distance at the true heading would be an accident of the sampling."""

STEP = float(np.deg2rad(3.0))
REFINED = float(np.deg2rad(0.1))
ROUND_SHARE = 0.008
"""A shape that no rotation changes by more than this share of its horizontal size is round: it has no heading."""

ALIKE_SHARE = 0.004
"""Headings that fit as well as the best but for this share of the size are symmetries of the shape."""


@dataclass(frozen=True, slots=True, eq=False)
class _Cloud(Frozen):
    """Points on a surface around their own middle; `tree` holds the dense ones and never turns."""

    sparse: Points
    tree: cKDTree
    size: float


def heading_error(mesh: TriangleMesh, truth: TriangleMesh) -> float | None:
    """The smallest rotation about the vertical that brings a mesh onto the true one [rad]; None for a round shape.

    Both are centred on their surfaces first, so that where they stand does not matter. Of the rotations that fit
    equally well (a box turned by half a turn, a square one by a quarter), the smallest counts.

    Args:
        mesh: As it stands, z up [m].
        truth: As it stands in the same frame.
    """
    turns = _fitting_turns(mesh, truth)
    return None if turns is None else min(map(_least, turns))


def heading_error_of_same(truth: TriangleMesh, turned: float) -> float | None:
    """The same for a mesh that is known to be the true one, turned: exact, but for symmetries [rad].

    Args:
        truth: As it stands, z up [m].
        turned: From the truth, about the vertical [rad].
    """
    symmetries = _fitting_turns(truth, truth)
    return None if symmetries is None else min(_least(turned - turn) for turn in (0.0, *symmetries))


def twist_about_z(quaternion_wxyz: Quaternion) -> float:
    """The part of a rotation that is about the vertical [rad]."""
    return float(2.0 * np.arctan2(quaternion_wxyz[3], quaternion_wxyz[0]))


def _fitting_turns(mesh: TriangleMesh, truth: TriangleMesh) -> list[float] | None:
    """Rotations about the vertical that bring a mesh onto another equally well; None where all do."""
    a, b = _cloud(mesh), _cloud(truth)
    angles = np.arange(0.0, 2 * np.pi, STEP)
    misfits = np.array([_misfit(a, b, angle) for angle in angles])
    if misfits.max() - misfits.min() <= ROUND_SHARE * b.size:
        return None
    dips = (misfits <= np.roll(misfits, 1)) & (misfits <= np.roll(misfits, -1)) & (misfits <= np.median(misfits))
    refined = [_refined(a, b, float(angle)) for angle in angles[dips]]
    best = min(misfit for _, misfit in refined)
    return [angle for angle, misfit in refined if misfit <= best + ALIKE_SHARE * b.size]


def _refined(a: _Cloud, b: _Cloud, angle: float) -> tuple[float, float]:
    """The best angle within a step of this one, and its misfit, by bisection of the interval in three."""
    low, high = angle - STEP, angle + STEP
    while high - low > REFINED:
        third = (high - low) / 3
        if _misfit(a, b, low + third) < _misfit(a, b, high - third):
            high -= third
        else:
            low += third
    middle = (low + high) / 2
    return middle, _misfit(a, b, middle)


def _misfit(a: _Cloud, b: _Cloud, angle: float) -> float:
    """Mean distance between the surfaces with `a` turned by this angle, both ways [m]; the trees never turn."""
    forward = b.tree.query(a.sparse @ _about_z(angle).T)[0].mean()
    backward = a.tree.query(b.sparse @ _about_z(-angle).T)[0].mean()
    return float(forward + backward) / 2


def _about_z(angle: float) -> Float64[np.ndarray, "3 3"]:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _least(angle: float) -> float:
    """The angle's size between 0 and half a turn."""
    return float(abs((angle + np.pi) % (2 * np.pi) - np.pi))


def _cloud(mesh: TriangleMesh) -> _Cloud:
    dense, sparse = surface_samples(mesh, DENSE)[0], surface_samples(mesh, SPARSE)[0]
    middle = dense.mean(axis=0)
    return _Cloud(sparse - middle, cKDTree(dense - middle), float(np.ptp(dense[:, :2], axis=0).max()))
