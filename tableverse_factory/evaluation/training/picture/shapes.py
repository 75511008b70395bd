"""Simple meshes that the generator lacks: unit boxes, lathes, superquadrics, prisms, handles, limbs.

Each fits the box from (-0.5, -0.5, 0) to (0.5, 0.5, 1) and is scaled where it stands.
"""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float64, Int32

Mesh = tuple[Float64[np.ndarray, "n 3"], Int32[np.ndarray, "k 3"]]

LATHES = 28
PRISMS = 14
HANDLES = 6
AROUND = 24


def make_shapes(seed: int) -> Iterator[tuple[str, Mesh]]:
    """Make every shape with the name of its kind."""
    rng = np.random.default_rng(seed)
    yield "box", make_box()
    yield "cylinder", _lathe(np.array([0.5, 0.5]), np.array([0.0, 1.0]), 32)
    yield "cone", _lathe(np.array([0.5, 0.3]), np.array([0.0, 1.0]), 32)
    for east, north in ((0.12, 0.12), (0.25, 0.25), (0.12, 0.3)):
        yield "cushion", _superquadric(east, north)
    for east, north in ((1.0, 1.0), (0.5, 1.0), (0.3, 1.0), (1.0, 0.4), (0.6, 0.6)):
        yield "blob", _superquadric(east, north)
    for index in range(LATHES):
        yield "lathe", _make_lathe(rng, smooth=bool(index % 2))
    for index in range(PRISMS):
        yield "prism", _make_prism(rng, hollow=index >= PRISMS // 2)
    for _ in range(HANDLES):
        yield "handle", _make_handle(rng)
    yield "limb", _make_limb()


def make_box() -> Mesh:
    """Make the unit box."""
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (0.0, 1.0)])
    quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    faces = [corner for a, b, c, d in quads for corner in ((a, b, c), (a, c, d))]
    return corners, np.array(faces, dtype=np.int32)


def _fit(points: np.ndarray, faces: np.ndarray) -> Mesh:
    low, size = points.min(axis=0), np.maximum(np.ptp(points, axis=0), 1e-9)
    return (points - low) / size - [0.5, 0.5, 0.0], faces.astype(np.int32)


def _join_rings(rings: np.ndarray, closed: bool = True) -> Mesh:
    """Join rings of points, shape (k, m, 3), by quads; the ends stay open."""
    count, around = rings.shape[:2]
    i, j = np.meshgrid(np.arange(count - 1), np.arange(around if closed else around - 1), indexing="ij")
    after = (j + 1) % around
    a, b, c, d = i * around + j, i * around + after, (i + 1) * around + j, (i + 1) * around + after
    faces = np.concatenate([np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, b, d), (a, d, c))])
    return rings.reshape(-1, 3), faces.astype(np.int32)


def _lathe(radius: np.ndarray, height: np.ndarray, around: int = AROUND) -> Mesh:
    """Turn a profile about z, its ends closed."""
    radius = np.concatenate([[1e-4], radius, [1e-4]])[:, None]
    height = np.concatenate([height[:1], height, height[-1:]])[:, None]
    angle = np.linspace(0, 2 * np.pi, around, endpoint=False)[None]
    rings = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.repeat(height, around, axis=1)], axis=-1)
    return _join_rings(rings)


def _superquadric(east: float, north: float) -> Mesh:
    def power(values: np.ndarray, exponent: float) -> np.ndarray:
        return np.sign(values) * np.abs(values) ** exponent

    up, around = np.linspace(-np.pi / 2, np.pi / 2, 14), np.linspace(0, 2 * np.pi, AROUND, endpoint=False)
    ring = power(np.cos(up), east)[:, None]
    height = np.repeat(power(np.sin(up), east)[:, None], AROUND, axis=1)
    x, y = ring * power(np.cos(around), north), ring * power(np.sin(around), north)
    return _fit(*_join_rings(np.stack([x, y, height], axis=-1)))


def _make_lathe(rng: np.random.Generator, smooth: bool) -> Mesh:
    """Make a body of revolution of random profile."""
    count = int(rng.integers(4, 9))
    knots = np.sort(rng.random(count))
    knots[[0, -1]] = 0.0, 1.0
    radius = np.clip(np.cumsum(rng.normal(0, 0.12, count)) + 0.4, 0.12, 0.5)
    if smooth:
        radius = np.convolve(np.pad(radius, 1, mode="edge"), [0.25, 0.5, 0.25], "valid")
    height = np.linspace(0, 1, 18)
    profile = np.interp(height, knots, radius)
    return _lathe(profile / (2 * profile.max()), height)


def _make_prism(rng: np.random.Generator, hollow: bool) -> Mesh:
    """Make an upright prism over a star-shaped polygon; a hollow one is an open tray with a wall."""
    count = int(rng.integers(5, 11))
    angle = np.sort(rng.random(count)) * 2 * np.pi
    radius = rng.uniform(0.32 if hollow else 0.22, 0.5, count)
    outline = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)
    inner = outline * rng.uniform(0.8, 0.95)
    rings = [(outline * 0.0, 0.0), (outline, 0.0), (outline, 1.0)]
    rings += [(inner, 1.0), (inner, 0.08), (inner * 0.0, 0.08)] if hollow else [(outline * 0.0, 1.0)]
    stacked = np.stack([np.column_stack([ring, np.full(count, z)]) for ring, z in rings])
    return _fit(*_join_rings(stacked))


def _make_handle(rng: np.random.Generator) -> Mesh:
    """Make a bent tube whose ends are at x = -0.5, as of a mug or a bag."""
    square = rng.uniform(0.3, 1.0)
    turn = np.linspace(-np.pi / 2, np.pi / 2, 12)
    middle = np.stack([np.cos(turn) ** square, np.sin(turn)], axis=-1)
    tangent = np.gradient(middle, axis=0)
    across = np.stack([tangent[:, 1], -tangent[:, 0]], axis=-1)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    angle = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    thick = rng.uniform(0.1, 0.2)
    in_plane = middle[:, None] + thick * np.cos(angle)[None, :, None] * across[:, None]
    sideways = np.repeat(np.sin(angle)[None], len(turn), axis=0)
    return _fit(*_join_rings(np.stack([in_plane[..., 0], sideways, in_plane[..., 1]], axis=-1)))


def _make_limb() -> Mesh:
    """Make a capsule along z whose round ends are an eighth of its length each."""
    turn = np.linspace(0, np.pi / 2, 5)
    radius = 0.5 * np.concatenate([np.sin(turn), np.cos(turn)])
    height = np.concatenate([0.125 * (1 - np.cos(turn)), 0.875 + 0.125 * np.sin(turn)])
    return _lathe(radius, height, 16)
