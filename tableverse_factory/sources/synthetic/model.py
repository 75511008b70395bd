"""What a generator of table-top objects answers: a closed mesh, its exact convex parts, its looks, its uses."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from schemas.geometry import Frozen, Points, TriangleMesh

Texture = Callable[[Points], Float64[np.ndarray, "n 3"]]
"""Positions in the object's own frame [m] to sRGB in 0–255."""


@dataclass(frozen=True, slots=True)
class GeneratorCavity:
    """The open inside of a container, round about the object's z axis.

    Attributes:
        floor: Height of the inner floor [m].
        rim: Height of the rim [m].
        floor_radius: Inner radius at the floor [m].
        rim_radius: Inner radius at the rim [m].
    """

    floor: float
    rim: float
    floor_radius: float
    rim_radius: float


@dataclass(frozen=True, slots=True)
class GeneratorTop:
    """A flat surface that things can stand on, centred on the object's z axis.

    Attributes:
        height: Above the object's own origin [m].
        half_x: Half its extent along the object's x axis [m].
        half_y: Half its extent along the object's y axis [m].
    """

    height: float
    half_x: float
    half_y: float


@dataclass(frozen=True, slots=True, eq=False)
class Model(Frozen):
    """One generated object, z up, resting on z = 0 as it naturally does, its foot about the origin.

    Attributes:
        label: What a person calls it: `bowl`, `cereal box`.
        description: With its colour: `a red bowl`.
        mesh: Closed surface [m], without colours.
        pieces: Corners of convex bodies whose union is the object, cavities left open. Each of shape (k, 3) [m].
        texture: Colours over the surface.
        mass_kg: What such a thing weighs, contents included.
        shiny: 0 for matt to 1 for polished metal: how often a depth sensor fails on it.
        cavity: Where contents go, for containers.
        top: Where riders stand, for things that are stacked upon.
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
