"""By how much an object must be turned about the vertical to lie as the true one does, symmetric shapes included."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.spatial import cKDTree

from schemas.geometry import Frozen, Points, Quaternion, TriangleMesh
from tableverse_factory.geometry.mesh.hulls import face_normals
from tableverse_factory.geometry.mesh.surface_samples import surface_samples

DENSE, FINE, COARSE = 6000, 1500, 300
"""Points that stand for a surface, and those of the other whose distance to it is asked, for the exact angle and for a
first look: never the same points, or the distance at the true heading would be an accident of the sampling."""

STEP = float(np.deg2rad(3.0))
ROUND_SHARE = 0.02
"""A shape that no rotation changes by more than this share of its horizontal size is round: it has no heading."""

ALIKE_SHARE = 0.01
"""Headings that fit as well as the best but for this share of the size are symmetries of the shape."""

APART = float(np.deg2rad(20.0))
"""Two headings nearer than this are one: what lies between is the noise of the samples."""


@dataclass(frozen=True, slots=True, eq=False)
class _Cloud(Frozen):
    """Points on a surface around their own middle; `tree` holds the dense ones, which never turn, with `normals`."""

    fine: Points
    coarse: Points
    normals: Points
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


def symmetric_turns(mesh: TriangleMesh) -> tuple[float, ...] | None:
    """Turns about the vertical that bring a mesh, as it stands, onto itself [rad]: 0 and its symmetries; None if round.

    A turn counts where the surfaces then lie within `ALIKE_SHARE` of the mesh's horizontal size of one another, as
    root mean square; a shape is round where no turn takes its surface further than `ROUND_SHARE` of that size.
    """
    turns = _fitting_turns(mesh, mesh)
    return None if turns is None else tuple(turns)


def twist_about_z(quaternion_wxyz: Quaternion) -> float:
    """The part of a rotation that is about the vertical [rad]."""
    return float(2.0 * np.arctan2(quaternion_wxyz[3], quaternion_wxyz[0]))


def _fitting_turns(mesh: TriangleMesh, truth: TriangleMesh) -> list[float] | None:
    """Rotations about the vertical that bring a mesh onto another equally well; None where all do."""
    a, b = _cloud(mesh), _cloud(truth)
    angles = np.arange(0.0, 2 * np.pi, STEP)
    misfits = np.array([_coarse_misfit(a, b, angle) for angle in angles])
    if misfits.max() - misfits.min() <= ROUND_SHARE * b.size:
        return None
    dips = (misfits <= np.roll(misfits, 1)) & (misfits <= np.roll(misfits, -1)) & (misfits <= np.median(misfits))
    refined = sorted((_refined(a, b, float(angle)) for angle in angles[dips]), key=lambda found: found[1])
    worst = refined[0][1] + ALIKE_SHARE * b.size
    turns: list[float] = []
    for angle, misfit in refined:
        if misfit <= worst and all(_least(angle - turn) >= APART for turn in turns):
            turns.append(angle)
    return turns


def _refined(a: _Cloud, b: _Cloud, angle: float) -> tuple[float, float]:
    """The best angle within a step of this one, and its misfit: over the whole step, then finer and finer."""
    best = angle
    for reach in (STEP, STEP / 10, STEP / 60):
        angles = best + reach * np.linspace(-1.0, 1.0, 13)
        misfits = [_fine_misfit(a, b, float(its)) for its in angles]
        best = float(angles[int(np.argmin(misfits))])
    return best, min(misfits)


def _coarse_misfit(a: _Cloud, b: _Cloud, angle: float) -> float:
    """Root mean square distance between the points of the surfaces with `a` turned by this angle, both ways [m].

    Of the squares, so that the handle of a mug counts, which is a tenth of its surface.
    """
    forward = (b.tree.query(a.coarse @ _about_z(angle).T)[0] ** 2).mean()
    backward = (a.tree.query(b.coarse @ _about_z(-angle).T)[0] ** 2).mean()
    return float(np.sqrt(forward) + np.sqrt(backward)) / 2


def _fine_misfit(a: _Cloud, b: _Cloud, angle: float) -> float:
    """Root mean square from points to the planes at the nearest points: blind to how far samples lie apart [m]."""
    return (_to_planes(a.fine @ _about_z(angle).T, b) + _to_planes(b.fine @ _about_z(-angle).T, a)) / 2


def _to_planes(points: Points, cloud: _Cloud) -> float:
    nearest = cloud.tree.query(points)[1]
    apart = np.einsum("ij,ij->i", points - cloud.tree.data[nearest], cloud.normals[nearest])
    return float(np.sqrt((apart**2).mean()))


def _about_z(angle: float) -> Float64[np.ndarray, "3 3"]:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _least(angle: float) -> float:
    """The angle's size between 0 and half a turn."""
    return float(abs((angle + np.pi) % (2 * np.pi) - np.pi))


def _cloud(mesh: TriangleMesh) -> _Cloud:
    fine, coarse = (surface_samples(mesh, count)[0] for count in (FINE, COARSE))
    dense, triangles = surface_samples(mesh, DENSE)
    middle = dense.mean(axis=0)
    size = float(np.ptp(dense[:, :2], axis=0).max())
    return _Cloud(fine - middle, coarse - middle, face_normals(mesh)[triangles], cKDTree(dense - middle), size)
