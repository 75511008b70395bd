"""Generated table-top objects: closed mesh, exact convex parts, colours, and surfaces to fill or stand on."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from schemas.geometry import Frozen, Points, TriangleMesh
from tableverse_factory.sources.synthetic.colors import describe
from tableverse_factory.sources.synthetic.solids import Solid

Texture = Callable[[Points], Float64[np.ndarray, "n 3"]]  # Positions in the object's own frame [m] to sRGB in 0–255


@dataclass(frozen=True, slots=True)
class GeneratorCavity:
    """The cavity of a container, round about the object's z axis: heights of floor and rim, and radii there [m]."""

    floor: float
    rim: float
    floor_radius: float
    rim_radius: float


@dataclass(frozen=True, slots=True)
class GeneratorTop:
    """A flat surface that objects can stand on, centred on the object's z axis: height and half extents [m]."""

    height: float
    half_x: float
    half_y: float


@dataclass(frozen=True, slots=True, eq=False)
class GeneratedObject(Frozen):
    """One generated object, z up, resting on z = 0 as it naturally does, its foot about the origin.

    Attributes:
        mesh: Closed surface [m], without colours.
        pieces: Corners of convex bodies whose union is the object, cavities left open. Each of shape (k, 3) [m].
        shiny: 0 for matt to 1 for polished metal: how often a depth sensor fails on it.
    """

    label: str
    description: str
    mesh: TriangleMesh
    pieces: tuple[Points, ...]
    texture: Texture
    mass_kg: float
    shiny: float = 0.0
    cavity: GeneratorCavity | None = None
    top: GeneratorTop | None = None


def make_object(
    label: str,
    adjective: str,
    solid: Solid,
    texture: Texture,
    mass_kg: float,
    shiny: float = 0.0,
    cavity: GeneratorCavity | None = None,
    top: GeneratorTop | None = None,
    *,
    noun: str = "",
    convex: bool = False,
) -> GeneratedObject:
    """Make an object from a solid; `noun` replaces the label in its description, and `convex` makes it one piece."""
    mesh = solid.to_mesh()
    pieces = (mesh.vertices,) if convex else solid.pieces
    return GeneratedObject(
        label, describe(adjective, noun or label), mesh, pieces, texture, mass_kg, shiny, cavity, top
    )


def make_box_top(size: Sequence[float]) -> GeneratorTop:
    """Make the top of a box of this size [m]."""
    return GeneratorTop(size[2], size[0] / 2, size[1] / 2)
