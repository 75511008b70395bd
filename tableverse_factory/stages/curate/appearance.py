"""Appearance of an object in words: colours from the mesh, shape from its dimensions."""

from dataclasses import dataclass

import numpy as np
from skimage.color import rgb2lab

from schemas.geometry import Frozen, TriangleMesh, Vector3
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.geometry.math.planes import fit_min_rectangle
from tableverse_factory.geometry.mesh.height_maps import measure_inscribed_width
from tableverse_factory.geometry.mesh.hulls import cross_rows
from tableverse_factory.geometry.relations.relations import BodyFeatures
from tableverse_factory.stages.curate.lexicon import COLORS

# Colours without a hue, by sRGB from 0 to 1. Black has less value; grey and white have less saturation, or a
# smaller difference of the largest and the smallest channel; white has more value than grey
_DARK = 0.16
_PALE, _DULL = 0.18, 0.1
_WHITE = 0.72
_LIGHT, _TINT = 80.0, 20.0  # in CIELAB: a lighter surface with less chroma is white in tinted light
# Upper end of each hue [degrees]; red wraps around.
_HUES = ((15, "red"), (40, "orange"), (68, "yellow"), (165, "green"), (255, "blue"), (290, "purple"), (335, "pink"))
_DIGITS = np.array([65_536, 256, 1])  # weights that pack an sRGB colour into one number

# Shapes by the sides of a tight box and the share of it that they fill: a box 1, a cylinder 0.79, a ball 0.52
_CUP_DEPTH = 0.6  # depth from which a vessel is a cup and no bowl, in widths of its opening
_ELONGATED = 3.5  # longest side of a long object, in middle ones
_FLAT = 0.15  # shortest side of a flat object, in longest ones
_BOX_FILL, _CYLINDER_FILL, _BALL_FILL = 0.83, 0.68, (0.42, 0.64)  # least of a box and of a cylinder; range of a ball
_BALL_SIDES, _CYLINDER_SIDES = 1.2, 1.25  # longest side of a ball and middle one of a cylinder, in shortest ones
_LEAST_FILL = {"box": 0.55, "can": 0.45, "cylinder": 0.45, "ball": 0.35}  # of what may be called so by someone else

_BASE_M = 0.001  # height over its lowest point of what an object stands on
_NARROW_BASE = 0.35  # width of that, in widths of the object, below which it can roll


@dataclass(frozen=True, slots=True, eq=False)
class DescribedObject(Frozen):
    """An object as names tell it from others: `size` [m] is along its mesh's own axes.

    `colors` is the surface share of each of `lexicon.COLORS`, empty where the mesh has no colours.
    """

    label: str
    body: BodyFeatures
    size: Vector3
    volume_m3: float
    colors: dict[str, float]


def measure_color_shares(mesh: TriangleMesh) -> dict[str, float]:
    """Measure the share of the surface in each named colour, by area; empty where the mesh has no colours."""
    if mesh.vertex_colors is None:
        return {}
    colors, index = np.unique(mesh.vertex_colors.astype(np.int64) @ _DIGITS, return_inverse=True)
    area = np.bincount(index, weights=_compute_vertex_areas(mesh))
    names = _classify_colors((colors[:, None] // _DIGITS % 256) / 255.0)
    totals = np.bincount(names, weights=area, minlength=len(COLORS)) / max(float(area.sum()), 1e-18)
    return {name: float(share) for name, share in zip(COLORS, totals, strict=True)}


def _compute_vertex_areas(mesh: TriangleMesh) -> np.ndarray:
    """Compute a third of the area of the triangles at each vertex [m²]."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    area = np.linalg.norm(cross_rows(b - a, c - a), axis=1) / 6.0
    count = len(mesh.vertices)
    of_corner = [np.bincount(mesh.faces[:, k], weights=area, minlength=count) for k in range(3)]
    return of_corner[0] + of_corner[1] + of_corner[2]


def _classify_colors(rgb: np.ndarray) -> np.ndarray:
    """Classify rows of sRGB in 0 to 1 by hue, saturation and value, as indices into `COLORS`."""
    value, least = rgb.max(axis=1), rgb.min(axis=1)
    spread = value - least
    saturation = spread / np.maximum(value, 1e-9)
    r, g, b = rgb.T
    safe = np.maximum(spread, 1e-9)
    hue = np.select([value == r, value == g], [(g - b) / safe % 6, (b - r) / safe + 2], (r - g) / safe + 4) * 60
    of_hue = np.array([COLORS.index(name) for _, name in _HUES] + [COLORS.index("red")])
    names = of_hue[np.searchsorted([edge for edge, _ in _HUES], hue)]
    brownish = (hue >= 10) & (hue < 45) & ((value < 0.6) | ((saturation < 0.5) & (value < 0.75)))
    names = np.where(brownish, COLORS.index("brown"), names)
    names = np.where((names == COLORS.index("red")) & (saturation < 0.45) & (value > 0.8), COLORS.index("pink"), names)
    grey = np.where(value > _WHITE, COLORS.index("white"), COLORS.index("grey"))
    names = np.where((saturation < _PALE) | (spread < _DULL), grey, names)
    lightness, *ab = rgb2lab(rgb).T
    names = np.where((lightness >= _LIGHT) & (np.hypot(*ab) < _TINT), COLORS.index("white"), names)
    return np.where(value < _DARK, COLORS.index("black"), names).astype(np.intp)


def name_shape(body: BodyFeatures, size: Vector3, volume_m3: float) -> str:
    """Choose a noun for an unnamed object from its dimensions alone."""
    if body.cavity is not None:
        opening = measure_inscribed_width(body.cavity.cells, body.heights.cell)
        return "cup" if body.cavity.depth > _CUP_DEPTH * opening else "bowl"
    short, middle, long = _measure_tight_box(body, size)
    fill = volume_m3 / max(short * middle * long, 1e-12)
    if long > _ELONGATED * middle:
        return "long object"
    if short < _FLAT * long:
        return "flat object"
    if fill > _BOX_FILL:
        return "box"
    if long < _BALL_SIDES * short and _BALL_FILL[0] < fill < _BALL_FILL[1]:
        return "ball"
    return "cylinder" if fill > _CYLINDER_FILL and middle < _CYLINDER_SIDES * short else "object"


def may_be_called(noun: str, body: BodyFeatures, size: Vector3, volume_m3: float) -> bool:
    """Whether an unnamed object may go by this noun: excludes only what fills too little of its box."""
    short, middle, long = _measure_tight_box(body, size)
    return volume_m3 >= _LEAST_FILL.get(noun, 0.0) * short * middle * long


def _measure_tight_box(body: BodyFeatures, size: Vector3) -> tuple[float, float, float]:
    """Sides of the smaller of two boxes, ascending [m]: along the mesh's own axes, and upright around the outline."""
    try:
        base = 2 * fit_min_rectangle(body.outline).half_size
    except GeometryError:
        base = np.zeros(2)
    upright = np.array([*base, body.high[2] - body.low[2]])
    tight = upright if 0.0 < np.prod(upright) < np.prod(size) else size
    short, middle, long = sorted(float(side) for side in tight)
    return short, middle, long


def can_roll(body: BodyFeatures) -> bool:
    """Whether the object stands on a patch or a line much narrower than itself: balls, fruit, cans on their side."""
    standing = body.heights.bottom <= body.low[2] + _BASE_M
    base, whole = (_measure_widths(np.argwhere(cells)) for cells in (standing, body.heights.filled))
    return bool((base / whole).min() < _NARROW_BASE)


def _measure_widths(cells: np.ndarray) -> np.ndarray:
    """Measure the width in each of eight directions [cells]."""
    angles = np.arange(8) * np.pi / 8
    along = cells @ np.stack([np.cos(angles), np.sin(angles)])
    return np.ptp(along, axis=0) + 1.0
