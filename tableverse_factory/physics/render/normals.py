"""Normals for shading: smooth where neighbouring faces agree, sharp at creases."""

import numpy as np
from jaxtyping import Float32

from schemas.geometry import TriangleMesh
from tableverse_factory.geometry.mesh.distinct_rows import find_distinct_rows

CREASE_COS = float(np.cos(np.deg2rad(42.0)))
MAX_VALENCE = 256
WELD_DECIMALS = 6


def compute_corner_normals(mesh: TriangleMesh) -> Float32[np.ndarray, "m 3 3"]:
    """Compute unit normals at each face's corners: the mean over the faces at that position within the crease angle."""
    corners = mesh.vertices[mesh.faces]
    scaled = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat = _normalize(scaled)
    here, there = _pair_corners(mesh)
    face_here, face_there = here // 3, there // 3
    agree = np.einsum("ij,ij->i", flat[face_here], flat[face_there]) > CREASE_COS
    # Weighted by area: the normal of a sliver is noise.
    weight = scaled[face_there] * agree[:, None]
    count = 3 * len(mesh.faces)
    total = np.stack([np.bincount(here, weight[:, k], minlength=count) for k in range(3)], axis=1)
    lost = np.linalg.norm(total, axis=1, keepdims=True) < 1e-18
    return _normalize(np.where(lost, np.repeat(flat, 3, axis=0), total)).reshape(-1, 3, 3).astype(np.float32)


def _pair_corners(mesh: TriangleMesh) -> tuple[np.ndarray, np.ndarray]:
    """List pairs of corners (3 * face + k) at one position, each with itself too, but not those of large fans."""
    _, welded = find_distinct_rows(np.round(mesh.vertices, WELD_DECIMALS))
    position = welded[mesh.faces].reshape(-1)
    order = np.argsort(position, kind="stable")
    starts = np.flatnonzero(np.diff(position[order], prepend=-1))
    valence = np.diff(np.append(starts, len(order)))
    group = np.repeat(np.arange(len(starts)), valence)
    alone = (valence > MAX_VALENCE)[group]
    pairs = np.where(alone, 1, valence[group])
    first = np.repeat(np.arange(len(order)), pairs)
    within = np.arange(len(first)) - np.repeat(np.cumsum(pairs) - pairs, pairs)
    second = np.where(alone[first], first, starts[group[first]] + within)
    return order[first], order[second]


def _normalize(vectors: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(length > 0.0, length, 1.0)
