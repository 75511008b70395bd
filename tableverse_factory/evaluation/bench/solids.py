"""Solids that stand on tables: cans, tins, jars, cartons, fruit, what is nearly such a kind, and vessels."""

from collections.abc import Iterator

import numpy as np
from manifold3d import CrossSection, JoinType, Manifold

from schemas.geometry import TriangleMesh
from tableverse_factory.geometry.mesh.voxel_solids import from_manifold

SEGMENTS = 64
# Radii and heights of a plate's section, a wall of 4 mm [m]
PLATE = np.array([(0.0, 0.0), (0.07, 0.0), (0.115, 0.02), (0.1134, 0.0237), (0.0691, 0.004), (0.0, 0.004)])


def make_solids() -> Iterator[tuple[str, TriangleMesh]]:
    """Make twenty bodies (cans, cartons, fruit, what has rounded edges, corners, knobs or necks), then four vessels."""
    for name, solid in (
        ("can", _stand(0.11, 0.033)),
        ("lying can", _stand(0.12, 0.033).rotate((90.0, 0.0, 0.0))),
        ("round tin", _stand(0.05, 0.08)),
        ("beaker", _stand(0.1, 0.03, 0.04)),
        ("orange", Manifold.sphere(0.036, SEGMENTS)),
        ("carton", Manifold.cube((0.12, 0.07, 0.05))),
        ("tall carton", Manifold.cube((0.06, 0.09, 0.14))),
        ("oval can", _stand(0.12, 0.04).scale((1.0, 0.85, 1.0))),
        ("flat oval can", _stand(0.12, 0.045).scale((1.0, 0.7, 1.0))),
        ("egg", Manifold.sphere(0.05, SEGMENTS).scale((1.0, 0.8, 1.2))),
        ("six-sided box", _stand(0.1, 0.04, segments=6)),
        ("eight-sided box", _stand(0.1, 0.04, segments=8)),
        ("nut", _stand(0.03, 0.04, segments=6) - _stand(0.03, 0.018)),
        ("meat tin", _round_edges(0.1, 0.058, 0.085, 0.021)),
        ("food box", _round_edges(0.16, 0.1, 0.06, 0.03)),
        ("wedge", _build_wedge()),
        ("jar", _stand(0.08, 0.04) + _stand(0.02, 0.033).translate((0.0, 0.0, 0.08))),
        ("pot with a knob", _stand(0.09, 0.045) + _stand(0.02, 0.01).translate((0.0, 0.0, 0.09))),
        ("square bottle", _round_edges(0.06, 0.06, 0.12, 0.01) + _stand(0.05, 0.014).translate((0.0, 0.0, 0.12))),
        ("pot with a spout", _stand(0.09, 0.045) + _stand(0.05, 0.01).rotate((0, 60, 0)).translate((0.03, 0.0, 0.05))),
        ("cup", _build_vessel(0.09, 0.033, 0.042, 0.003)),
        ("mug", _build_vessel(0.095, 0.04, 0.041, 0.004) + _build_handle()),
        ("bowl", _build_vessel(0.06, 0.04, 0.075, 0.004)),
        ("plate", Manifold.revolve(CrossSection([PLATE]), SEGMENTS)),
    ):
        yield name, from_manifold(solid)


def _stand(height: float, radius: float, top: float | None = None, segments: int = SEGMENTS) -> Manifold:
    return Manifold.cylinder(height, radius, radius if top is None else top, segments)


def _round_edges(length: float, width: float, height: float, radius: float) -> Manifold:
    core = CrossSection.square((length - 2 * radius, width - 2 * radius), True)
    return Manifold.extrude(core.offset(radius, JoinType.Round, circular_segments=SEGMENTS), height)


def _build_vessel(height: float, base: float, top: float, wall: float) -> Manifold:
    """Build a vessel with a floor; its wall is measured on the level."""
    return _stand(height, base, top) - _stand(height, base - wall, top - wall).translate((0.0, 0.0, wall))


def _build_handle() -> Manifold:
    """Build the handle of the mug, which ends inside its wall."""
    ring = Manifold.revolve(CrossSection.circle(0.005, SEGMENTS).translate((0.026, 0.0)), SEGMENTS)
    handle = ring.rotate((90.0, 0.0, 0.0)).translate((0.044, 0.0, 0.05))
    return handle - _stand(0.1, 0.0385)


def _build_wedge() -> Manifold:
    corners = [(x, y, z) for x, y in ((-0.06, -0.04), (-0.06, 0.04)) for z in (0.0, 0.05)]
    corners += [(0.06, y, z) for y in (-0.04, 0.04) for z in (0.0, 0.03)]
    return Manifold.hull_points(np.array(corners))
