"""Heading error of an object against the truth, with symmetries of the shape taken into account."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.spatial import cKDTree

from schemas.geometry import Frozen, Points, Quaternion, TriangleMesh
from tableverse_factory.geometry.mesh.hulls import compute_face_normals
from tableverse_factory.geometry.mesh.surface_samples import sample_surface

DENSE, FINE, COARSE = 6000, 1500, 300
"""Number of sample points: of the dense surface, and of the queries for the exact angle and for the coarse search.
Dense and query points differ, or the distance at the true heading would be an artefact of sampling."""

STEP = float(np.deg2rad(3.0))
ROUND_SHARE = 0.02
"""A shape is round, without a heading, if no rotation moves its surface by more than this share of its size."""

ALIKE_SHARE = 0.01  # headings whose misfit exceeds the best one by at most this share of the size are symmetries

APART = float(np.deg2rad(20.0))
"""Headings nearer than this count as one; smaller differences are sampling noise [rad]."""


@dataclass(frozen=True, slots=True, eq=False)
class _Cloud(Frozen):
    """Sampled points of a surface, centred; `tree` holds the dense ones, which never turn, with `normals`."""

    fine: Points
    coarse: Points
    normals: Points
    tree: cKDTree
    size: float


def compute_heading_error(mesh: TriangleMesh, truth: TriangleMesh) -> float | None:
    """Compute the smallest rotation about the vertical that aligns a mesh with the true one [rad]; None if round.

    Both are in the scene frame, z up [m], and are centred on their surfaces first. Of the rotations that fit equally
    well (a box turned by half a turn, a square one by a quarter), the smallest counts.
    """
    turns = _find_fitting_turns(mesh, truth)
    return None if turns is None else min(map(_wrap_angle, turns))


def compute_heading_error_of_same(truth: TriangleMesh, turned: float) -> float | None:
    """Compute the heading error of the true mesh turned by a known angle, exact but for symmetries [rad].

    The mesh is in the scene frame, z up [m]; None for a round shape.
    """
    symmetries = _find_fitting_turns(truth, truth)
    return None if symmetries is None else min(_wrap_angle(turned - turn) for turn in (0.0, *symmetries))


def find_symmetric_turns(mesh: TriangleMesh) -> tuple[float, ...] | None:
    """Find the turns about the vertical that map a mesh onto itself [rad]: 0 and its symmetries; None if round.

    A turn counts if the root mean square distance of the surfaces is then within `ALIKE_SHARE` of the horizontal size;
    a shape is round if no turn moves its surface further than `ROUND_SHARE` of that size.
    """
    turns = _find_fitting_turns(mesh, mesh)
    return None if turns is None else tuple(turns)


def compute_twist_about_z(quaternion_wxyz: Quaternion) -> float:
    """Compute the twist of a rotation about the vertical [rad]."""
    return float(2.0 * np.arctan2(quaternion_wxyz[3], quaternion_wxyz[0]))


def _find_fitting_turns(mesh: TriangleMesh, truth: TriangleMesh) -> list[float] | None:
    """Find the rotations about the vertical that align two meshes equally well; None if all do."""
    a, b = _sample_cloud(mesh), _sample_cloud(truth)
    angles = np.arange(0.0, 2 * np.pi, STEP)
    misfits = np.array([_compute_coarse_misfit(a, b, angle) for angle in angles])
    if misfits.max() - misfits.min() <= ROUND_SHARE * b.size:
        return None
    dips = (misfits <= np.roll(misfits, 1)) & (misfits <= np.roll(misfits, -1)) & (misfits <= np.median(misfits))
    refined = sorted((_refine_turn(a, b, float(angle)) for angle in angles[dips]), key=lambda found: found[1])
    worst = refined[0][1] + ALIKE_SHARE * b.size
    turns: list[float] = []
    for angle, misfit in refined:
        if misfit <= worst and all(_wrap_angle(angle - turn) >= APART for turn in turns):
            turns.append(angle)
    return turns


def _refine_turn(a: _Cloud, b: _Cloud, angle: float) -> tuple[float, float]:
    """Refine an angle within one step, from coarse to fine; return the best angle and its misfit."""
    best = angle
    for reach in (STEP, STEP / 10, STEP / 60):
        angles = best + reach * np.linspace(-1.0, 1.0, 13)
        misfits = [_compute_fine_misfit(a, b, float(its)) for its in angles]
        best = float(angles[int(np.argmin(misfits))])
    return best, min(misfits)


def _compute_coarse_misfit(a: _Cloud, b: _Cloud, angle: float) -> float:
    """Compute the root mean square distance between the surfaces with `a` turned, both ways [m].

    Squares give weight to the handle of a mug, a tenth of its surface.
    """
    forward = (b.tree.query(a.coarse @ _make_rotation(angle).T)[0] ** 2).mean()
    backward = (a.tree.query(b.coarse @ _make_rotation(-angle).T)[0] ** 2).mean()
    return float(np.sqrt(forward) + np.sqrt(backward)) / 2


def _compute_fine_misfit(a: _Cloud, b: _Cloud, angle: float) -> float:
    """Compute the root mean square distance from points to the planes at the nearest points [m].

    It does not depend on the spacing of the samples.
    """
    return (
        _compute_plane_distance(a.fine @ _make_rotation(angle).T, b)
        + _compute_plane_distance(b.fine @ _make_rotation(-angle).T, a)
    ) / 2


def _compute_plane_distance(points: Points, cloud: _Cloud) -> float:
    nearest = cloud.tree.query(points)[1]
    apart = np.einsum("ij,ij->i", points - cloud.tree.data[nearest], cloud.normals[nearest])
    return float(np.sqrt((apart**2).mean()))


def _make_rotation(angle: float) -> Float64[np.ndarray, "3 3"]:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _wrap_angle(angle: float) -> float:
    """Return the magnitude of an angle, between 0 and half a turn [rad]."""
    return float(abs((angle + np.pi) % (2 * np.pi) - np.pi))


def _sample_cloud(mesh: TriangleMesh) -> _Cloud:
    fine, coarse = (sample_surface(mesh, count)[0] for count in (FINE, COARSE))
    dense, triangles = sample_surface(mesh, DENSE)
    middle = dense.mean(axis=0)
    size = float(np.ptp(dense[:, :2], axis=0).max())
    return _Cloud(fine - middle, coarse - middle, compute_face_normals(mesh)[triangles], cKDTree(dense - middle), size)
