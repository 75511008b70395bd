"""Arrangement of things on a table while it is changed: who depends on whom, and where there is room."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import networkx as nx
import numpy as np
from jaxtyping import Float64

from schemas.geometry import ConvexPieces, Pose, Vector3
from schemas.objects import PlacedObject, Table
from tableverse_factory.core.errors import InputError
from tableverse_factory.geometry.collision.solids import Solids, find_near_pieces, place_pieces
from tableverse_factory.geometry.math.aabb import aabb
from tableverse_factory.geometry.math.transforms import (
    multiply_quaternions,
    normalize_quaternion,
    quaternion_about_z,
    rotation_matrix,
)
from tableverse_factory.geometry.mesh.mass_integrals import compute_volumes_and_centers
from tableverse_factory.geometry.relations.support import find_piece_support
from tableverse_factory.physics.mjcf.slab import OBJECT_MARGIN_M, Slab

BASE_M = 0.002  # what is this near to the lowest point of a thing carries it
TOUCH_M = 0.0015
STAND_MARGIN_M = 0.002
SINK_M = 0.001  # deepest overlap of a thing with what carries it: rectification lifts it
_ANGLES = np.arange(32) * (2 * np.pi / 32)
_DIRECTIONS = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)])
_LEAST_PIECE_M3 = 1e-12

Dependencies = frozenset[tuple[str, str]]


@dataclass(frozen=True, slots=True)
class Unit:
    """Things that move as one: `root`, and all that would fall without it; `stands` if the table alone carries them."""

    root: str
    members: frozenset[str]
    stands: bool


class Arrangement:
    """Objects at their present poses, by id; changes replace objects, and nothing else."""

    def __init__(self, objects: Sequence[PlacedObject], table: Table) -> None:
        """Find who depends on whom at the poses of the objects, which have their pieces."""
        self.table = table
        self._objects = {item.object_id: item for item in objects}
        self._solids = {item.object_id: place_object(item) for item in objects}
        self._depends = _find_dependencies(self._objects, self._solids)

    @property
    def objects(self) -> Mapping[str, PlacedObject]:
        """The objects by id, in their first order."""
        return self._objects

    def list_units(self) -> list[Unit]:
        """List what can be taken up as one, whole piles included; each set of things once, by its lowest thing."""
        found: dict[frozenset[str], Unit] = {}
        for name in sorted(self._objects, key=self._get_height):
            members = self._collect_dependents(name)
            leaning = {of for of, on in self._depends if of in members and on not in members}
            if leaning - {name}:
                continue  # they would lose what else carries them
            found.setdefault(members, Unit(name, members, stands=not leaning))
        for members in self._list_piles():
            found.setdefault(members, Unit(min(members, key=self._get_height), members, stands=True))
        return list(found.values())

    def _get_height(self, name: str) -> tuple[float, str]:
        return round(float(self._solids[name].points[:, 2].min()), 3), name

    def find_supports(self, names: Collection[str]) -> frozenset[str]:
        """Find the other things that these depend on."""
        return frozenset(on for of, on in self._depends if of in names and on not in names)

    def get_points(self, names: Iterable[str]) -> Float64[np.ndarray, "n 3"]:
        """Vertices of the pieces of these things in the table frame [m]."""
        return np.concatenate([self._solids[name].points for name in names])

    def stands_alone(self, item: PlacedObject) -> bool:
        """Whether a thing would stand in its orientation on a table."""
        return _stands_alone(item, place_object(item))

    def fits(self, changed: Sequence[PlacedObject], gap_m: float, carriers: Collection[str] = ()) -> bool:
        """Whether changed things keep `gap_m` [m] from all others; carriers may touch them."""
        names = {item.object_id for item in changed}
        mine = [place_object(item) for item in changed]
        for name, other in self._solids.items():
            if name in names:
                continue
            least = -SINK_M if name in carriers else gap_m
            for solids in mine:
                if any(gap < least for gap, _ in find_near_pieces(solids, other, max(least, 0.0))):
                    return False
        return True

    def holds(self, changed: Sequence[PlacedObject], margin_m: float = OBJECT_MARGIN_M) -> bool:
        """Whether things lie over the table, `margin_m` from its edge [m]."""
        half = self.table.half_size_xy - margin_m
        region = Slab(self.table.center_xy, half, self.table.yaw, self.table.color)
        return all(bool(region.holds(place_object(item).points).all()) for item in changed)

    def is_near(self, changed: Sequence[PlacedObject], reach_m: float) -> bool:
        """Whether the box of changed things is within `reach_m` [m] of that of another, from above, if there is any."""
        names = {item.object_id for item in changed}
        points = np.concatenate([place_object(item).points for item in changed])
        low, high = aabb(points)
        others = [aabb(solids.points) for name, solids in self._solids.items() if name not in names]
        gaps = (np.maximum(np.maximum(low - box[1], box[0] - high)[:2], 0.0) for box in others)
        return not others or min(float(np.linalg.norm(gap)) for gap in gaps) <= reach_m

    def replace(self, changed: Iterable[PlacedObject], stands: bool = False) -> None:
        """Put things at their new poses; those that now stand on the table depend on no others."""
        for item in changed:
            name = item.object_id
            self._objects[name] = item
            self._solids[name] = place_object(item)
            if stands:
                self._depends = frozenset(pair for pair in self._depends if pair[0] != name)

    def remove(self, name: str) -> None:
        """Take a thing away on which nothing depends."""
        del self._objects[name], self._solids[name]
        self._depends = frozenset(pair for pair in self._depends if name not in pair)

    def _list_piles(self) -> list[frozenset[str]]:
        """List the sets of things that depend on one another in the end, by the first of their ids."""
        graph = nx.Graph()
        graph.add_nodes_from(self._objects)
        graph.add_edges_from(self._depends)
        return sorted((frozenset(pile) for pile in nx.connected_components(graph)), key=min)

    def _collect_dependents(self, name: str) -> frozenset[str]:
        members, waiting = {name}, [name]
        while waiting:
            on_it = waiting.pop()
            news = {of for of, on in self._depends if on == on_it} - members
            members |= news
            waiting += sorted(news)
        return frozenset(members)


def place_object(item: PlacedObject) -> Solids:
    """Place the pieces of an object in the table frame."""
    return place_pieces(_get_pieces(item), item.pose, item.scale)


def _get_pieces(item: PlacedObject) -> ConvexPieces:
    if item.pieces is None:
        raise InputError(f"{item.object_id} has no convex pieces", "bad_scene")
    return item.pieces


def move_object(item: PlacedObject, pivot: Vector3, offset: Vector3, angle: float = 0.0) -> PlacedObject:
    """Turn an object about the vertical through `pivot` by `angle` [rad], then move it by `offset` [m]."""
    turn = quaternion_about_z(angle)
    position = rotation_matrix(turn) @ (item.pose.position - pivot) + pivot + offset
    return replace(
        item, pose=Pose(position, normalize_quaternion(multiply_quaternions(turn, item.pose.quaternion_wxyz)))
    )


def scale_object(item: PlacedObject, pivot: Vector3, factor: float) -> PlacedObject:
    """Scale an object about a point of the table frame."""
    position = pivot + factor * (item.pose.position - pivot)
    return replace(item, scale=factor * item.scale, pose=Pose(position, item.pose.quaternion_wxyz))


def _find_dependencies(objects: Mapping[str, PlacedObject], solids: Mapping[str, Solids]) -> Dependencies:
    """Find pairs (thing, other) such that the thing may fall without the other.

    Those are what carries it, what it is in, and, for one that would not stand there by itself, all that it touches.
    """
    names = list(objects)
    pairs = {(names[i], names[j]) for i, j in find_piece_support(list(solids.values()))}
    pairs |= {(name, item.contained_in) for name, item in objects.items() if item.contained_in is not None}
    carried = {thing for thing, _ in pairs}
    alone = {
        name: _stands_alone(item, solids[name]) and (name in carried or solids[name].points[:, 2].min() < BASE_M)
        for name, item in objects.items()
    }
    for a, b in combinations(names, 2):
        if (alone[a] and alone[b]) or not any(find_near_pieces(solids[a], solids[b], TOUCH_M)):
            continue
        pairs |= {(thing, other) for thing, other in ((a, b), (b, a)) if not alone[thing]}
    return frozenset(pairs)


def _stands_alone(item: PlacedObject, solids: Solids) -> bool:
    """Whether the centre of mass is over what is lowest, as if it stood on a table."""
    volumes, centers = compute_volumes_and_centers(_get_pieces(item).hulls, _LEAST_PIECE_M3)
    own = (volumes @ centers) / volumes.sum()
    middle = item.scale * rotation_matrix(item.pose.quaternion_wxyz) @ own + item.pose.position
    points = solids.points
    base = points[points[:, 2] <= points[:, 2].min() + BASE_M][:, :2]
    return bool((middle[:2] @ _DIRECTIONS <= (base @ _DIRECTIONS).max(axis=0) + STAND_MARGIN_M).all())
