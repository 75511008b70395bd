"""Collision and visual primitives of the Panda-like arm.

Each is given in the frame of its link, whose z is the axis of the joint before it (`panda.JOINTS`).
"""

from dataclasses import dataclass
from functools import partial

import mujoco

Point = tuple[float, float, float]
Rgba = tuple[float, float, float, float]
WHITE: Rgba = (0.93, 0.94, 0.95, 1.0)
GREY: Rgba = (0.62, 0.65, 0.69, 1.0)
DARK: Rgba = (0.15, 0.16, 0.18, 1.0)
BLUE: Rgba = (0.16, 0.47, 0.78, 1.0)


@dataclass(frozen=True, slots=True)
class LinkShape:
    """Primitive shape: capsules and cylinders go from `a` to `b` [m]; boxes have middle `a` and half size `b` [m]."""

    kind: mujoco.mjtGeom
    a: Point
    b: Point
    radius: float = 0.0
    rgba: Rgba = WHITE


capsule = partial(LinkShape, mujoco.mjtGeom.mjGEOM_CAPSULE)  # its half balls reach beyond `a` and `b`
cylinder = partial(LinkShape, mujoco.mjtGeom.mjGEOM_CYLINDER)


def box(middle: Point, half_size: Point, rgba: Rgba = WHITE) -> LinkShape:
    """Make a box along the axes of the link."""
    return LinkShape(mujoco.mjtGeom.mjGEOM_BOX, middle, half_size, 0.0, rgba)


FINGER_ROOT_M = 0.0584  # start of the fingers, from the hand's flange
HAND = box((0.0, 0.0, 0.033), (0.0315, 0.102, 0.033))
SHANK = box((0.0, 0.013, 0.018), (0.0105, 0.009, 0.018), GREY)
# Pad of the left finger, in a frame whose y = 0 is the gripping face; its middle is at the height of the TCP
PAD = box((0.0, 0.006, 0.045), (0.0105, 0.006, 0.0105), DARK)
COLLISION_SHAPES: tuple[tuple[LinkShape, ...], ...] = (  # by link, 0 to 7
    (box((-0.0375, 0.0, 0.035), (0.1, 0.095, 0.035)), cylinder((0.0, 0.0, 0.0), (0.0, 0.0, 0.14), 0.075)),
    (capsule((0.0, 0.0, -0.17), (0.0, 0.0, 0.0), 0.06), capsule((0.0, -0.05, 0.0), (0.0, 0.05, 0.0), 0.06)),
    (capsule((0.0, 0.0, -0.06), (0.0, 0.0, 0.06), 0.06), capsule((0.0, -0.13, 0.0), (0.0, 0.0, 0.0), 0.06)),
    (capsule((0.0, 0.0, -0.15), (0.0, 0.0, -0.04), 0.06), capsule((0.0825, -0.055, 0.0), (0.0825, 0.055, 0.0), 0.055)),
    (capsule((0.0, 0.0, -0.06), (0.0, 0.0, 0.06), 0.055), capsule((-0.0825, 0.06, 0.0), (-0.0825, 0.11, 0.0), 0.055)),
    (
        capsule((0.0, 0.0, -0.27), (0.0, 0.0, -0.2), 0.055),
        capsule((0.0, 0.06, -0.2), (0.0, 0.085, -0.06), 0.03),
        capsule((0.0, 0.05, 0.0), (0.0, 0.08, 0.0), 0.048),
    ),
    (capsule((0.0, 0.0, -0.06), (0.0, 0.0, 0.01), 0.048), capsule((0.05, 0.0, 0.0), (0.09, 0.0, 0.0), 0.05)),
    (cylinder((0.0, 0.0, 0.03), (0.0, 0.0, 0.107), 0.045),),
)
VISUAL_SHAPES: tuple[tuple[LinkShape, ...], ...] = (  # by link, 0 to 7
    (
        box((-0.0375, 0.0, 0.004), (0.1, 0.095, 0.004), DARK),
        box((-0.045, 0.0, 0.037), (0.088, 0.082, 0.029)),
        box((-0.134, 0.0, 0.036), (0.002, 0.04, 0.018), GREY),
        cylinder((0.0, 0.0, 0.008), (0.0, 0.0, 0.132), 0.075),
        cylinder((0.0, 0.0, 0.132), (0.0, 0.0, 0.141), 0.069, DARK),
    ),
    (
        cylinder((0.0, 0.0, -0.192), (0.0, 0.0, -0.09), 0.066),
        capsule((0.0, 0.0, -0.12), (0.0, 0.0, -0.01), 0.062),
        cylinder((0.0, -0.088, 0.0), (0.0, 0.088, 0.0), 0.06),
        cylinder((0.0, 0.088, 0.0), (0.0, 0.094, 0.0), 0.05, GREY),
        cylinder((0.0, -0.094, 0.0), (0.0, -0.088, 0.0), 0.05, GREY),
    ),
    (
        cylinder((0.0, 0.0, -0.06), (0.0, 0.0, 0.06), 0.0605),
        capsule((0.0, -0.13, 0.0), (0.0, 0.0, 0.0), 0.057),
        cylinder((0.0, -0.19, 0.0), (0.0, -0.1, 0.0), 0.061),
        cylinder((0.0, -0.198, 0.0), (0.0, -0.19, 0.0), 0.057, DARK),
    ),
    (
        cylinder((0.0, 0.0, -0.118), (0.0, 0.0, -0.05), 0.061),
        capsule((0.0, 0.0, -0.07), (0.0, 0.0, -0.03), 0.058),
        capsule((0.0, 0.0, -0.03), (0.0825, 0.0, 0.0), 0.048),
        cylinder((0.0825, -0.088, 0.0), (0.0825, 0.088, 0.0), 0.053),
        cylinder((0.0825, 0.088, 0.0), (0.0825, 0.094, 0.0), 0.044, GREY),
        cylinder((0.0825, -0.094, 0.0), (0.0825, -0.088, 0.0), 0.044, GREY),
    ),
    (
        cylinder((0.0, 0.0, -0.055), (0.0, 0.0, 0.055), 0.0535),
        capsule((0.0, 0.0, 0.0), (-0.0825, 0.06, 0.0), 0.046),
        capsule((-0.0825, 0.06, 0.0), (-0.0825, 0.09, 0.0), 0.054),
        cylinder((-0.0825, 0.08, 0.0), (-0.0825, 0.118, 0.0), 0.058),
        cylinder((-0.0825, 0.118, 0.0), (-0.0825, 0.125, 0.0), 0.053, DARK),
    ),
    (
        cylinder((0.0, 0.0, -0.259), (0.0, 0.0, -0.2), 0.058),
        capsule((0.0, 0.004, -0.21), (0.0, 0.03, -0.17), 0.053),
        capsule((0.0, 0.03, -0.18), (0.0, 0.072, -0.05), 0.037),
        capsule((0.0, 0.06, -0.09), (0.0, 0.062, 0.0), 0.04),
        cylinder((0.0, 0.05, 0.0), (0.0, 0.105, 0.0), 0.047),
        cylinder((0.0, 0.105, 0.0), (0.0, 0.111, 0.0), 0.039, GREY),
    ),
    (
        cylinder((0.0, 0.0, -0.05), (0.0, 0.0, 0.045), 0.047),
        cylinder((0.0, 0.0, 0.045), (0.0, 0.0, 0.051), 0.039, GREY),
        capsule((0.0, 0.0, 0.0), (0.088, 0.0, 0.0), 0.043),
        cylinder((0.088, -0.05, 0.0), (0.088, 0.045, 0.0), 0.046),
        cylinder((0.088, 0.045, 0.0), (0.088, 0.051, 0.0), 0.038, GREY),
    ),
    (
        cylinder((0.0, 0.0, 0.05), (0.0, 0.0, 0.1), 0.045),
        cylinder((0.0, 0.0, 0.1), (0.0, 0.0, 0.107), 0.041, DARK),
        capsule((0.035, 0.035, 0.075), (0.045, 0.045, 0.075), 0.016),
        cylinder((0.045, 0.045, 0.088), (0.045, 0.045, 0.092), 0.009, BLUE),
    ),
)
HAND_VISUAL = (
    cylinder((0.0, 0.0, 0.0), (0.0, 0.0, 0.012), 0.041, GREY),
    box((0.0, 0.0, 0.034), (0.0285, 0.082, 0.024)),
    cylinder((0.0, 0.082, 0.01), (0.0, 0.082, 0.058), 0.0285),
    cylinder((0.0, -0.082, 0.01), (0.0, -0.082, 0.058), 0.0285),
    box((0.0, 0.0, 0.062), (0.016, 0.096, 0.004), DARK),
)
FINGER_VISUAL = (
    box((0.0, 0.013, 0.006), (0.0105, 0.0095, 0.006), DARK),
    box((0.0, 0.0155, 0.024), (0.0095, 0.0065, 0.013), GREY),
    box((0.0, 0.0075, 0.045), (0.0098, 0.0045, 0.0102), GREY),
    box((0.0, 0.0015, 0.045), (0.0105, 0.0015, 0.0105), DARK),
)
