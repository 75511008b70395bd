"""Small layouts of convex things, cheap enough for property tests, and what is measured on them."""

from collections.abc import Sequence
from itertools import combinations, product

import coal
import numpy as np
import trimesh
from hypothesis import strategies as st

from schemas.geometry import ConvexPieces, Pose, TriangleMesh
from schemas.objects import PlacedObject
from tableverse_factory.geometry.math.transforms import multiply_quaternions, quaternion_about_z
from tableverse_factory.geometry.mesh.meshes import from_trimesh
from tableverse_factory.stages.rectify.lccr import RectificationResult
from tableverse_factory.stages.rectify.rigid_part import RigidPart, make_rigid_part


def box(*size: float) -> TriangleMesh:
    return from_trimesh(trimesh.creation.box(size))


def ball(radius: float) -> TriangleMesh:
    return from_trimesh(trimesh.creation.icosphere(subdivisions=1, radius=radius))


def placed(
    name: str,
    mesh: TriangleMesh,
    position: tuple[float, float, float],
    angle: float = 0.0,
    contained_in: str | None = None,
) -> PlacedObject:
    pose = Pose(np.array(position), quaternion_about_z(angle))
    return PlacedObject(name, "thing", 1.0, mesh, 1.0, pose, contained_in)


def part(item: PlacedObject, uncovered_m: float = 0.0) -> RigidPart:
    """The part of an object whose mesh is convex already."""
    return make_rigid_part(item, ConvexPieces((item.mesh,), 1.0, 0.0, "convex", uncovered_m=uncovered_m))


def channel(
    name: str, position: tuple[float, float, float], angle: float = 0.0, contained_in: str | None = None
) -> RigidPart:
    """A floor of 100 x 60 mm, 10 mm thick, between two walls 50 mm high: three pieces, open at both ends."""
    floor = trimesh.creation.box((0.1, 0.06, 0.01), trimesh.transformations.translation_matrix((0, 0, 0.005)))
    walls = [
        trimesh.creation.box((0.1, 0.01, 0.05), trimesh.transformations.translation_matrix((0, y, 0.025)))
        for y in (-0.035, 0.035)
    ]
    item = placed(name, from_trimesh(trimesh.util.concatenate([floor, *walls])), position, angle, contained_in)
    return make_rigid_part(item, ConvexPieces(tuple(from_trimesh(piece) for piece in (floor, *walls)), 1.0, 0.0, "cut"))


def turned(item: PlacedObject, quarter_turns: int) -> PlacedObject:
    """The object in a layout that was turned about the origin."""
    quarter = [np.eye(2), np.array([[0.0, -1.0], [1.0, 0.0]])][quarter_turns % 2] * (1 - 2 * (quarter_turns % 4 // 2))
    position = np.array([*(quarter @ item.pose.position[:2]), item.pose.position[2]])
    turn = quaternion_about_z(np.pi / 2 * quarter_turns)
    pose = Pose(position, multiply_quaternions(turn, item.pose.quaternion_wxyz))
    return PlacedObject(item.object_id, "thing", 1.0, item.mesh, 1.0, pose, item.contained_in)


def offsets(result: RectificationResult) -> np.ndarray:
    return np.array([moved.body.offset for moved in result.parts])


def smallest_gap(parts: Sequence[RigidPart]) -> float:
    """Least distance between pieces of different parts, by another way than the code: all pairs of pieces, no boxes."""
    request, result = coal.DistanceRequest(), coal.DistanceResult()
    first, second = coal.Transform3s(), coal.Transform3s()
    gaps = [np.inf]
    for one, other in combinations(parts, 2):
        first.setTranslation(one.body.offset)
        second.setTranslation(other.body.offset)
        for a, b in product(shapes(one), shapes(other)):
            result.clear()
            gaps.append(coal.distance(a, first, b, second, request, result))
    return min(gaps)


def shapes(one: RigidPart) -> list[coal.Convex]:
    return [one.body.solids.shape(k) for k in range(len(one.body.solids.starts))]


def quarter_turns(count: int) -> np.ndarray:
    """Rotation matrix of so many quarter turns about z."""
    angle = np.pi / 2 * count
    return np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])


FAULTLESS = {
    "a bridge on two cubes": [
        placed("a", box(0.1, 0.1, 0.1), (-0.1, 0, 0.05)),
        placed("b", box(0.1, 0.1, 0.1), (0.1, 0, 0.05)),
        placed("bridge", box(0.2, 0.05, 0.01), (0, 0, 0.1056)),
    ],
    "a mug across a plate's edge": [
        placed("mug", box(0.08, 0.08, 0.1), (0.105, 0, 0.0706)),
        placed("plate", box(0.2, 0.2, 0.02), (0, 0, 0.01)),
    ],
}
"""Nothing touches and nothing floats: 0.6 mm lie between what stands and what carries it."""

MILLIMETRES = st.integers(-150, 150).map(lambda n: n / 1000)
_sizes = st.integers(10, 120).map(lambda n: n / 1000)
_meshes = st.one_of(st.builds(box, _sizes, _sizes, _sizes), st.integers(10, 50).map(lambda n: ball(n / 1000)))


@st.composite
def layouts(draw: st.DrawFn, most: int = 6) -> list[PlacedObject]:
    """A few boxes and balls near one another, many of them overlapping; whole millimetres make ties likely."""
    count = draw(st.integers(1, most))
    return [
        placed(
            f"obj_{k:03d}",
            draw(_meshes),
            (draw(MILLIMETRES), draw(MILLIMETRES), draw(st.integers(0, 80)) / 1000),
            draw(st.sampled_from([0.0, 0.3, 1.1, np.pi / 2])),
        )
        for k in range(count)
    ]
