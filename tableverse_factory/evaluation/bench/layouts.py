"""Layouts to measure on: what a registration saw, the pieces, and where the things truly rest."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
from jaxtyping import Float64
from pydantic import TypeAdapter, ValidationError

from schemas.config import Config
from schemas.geometry import ConvexPieces, Pose
from schemas.layout import LayoutPose
from schemas.manifest import ImageRow, SceneKind
from schemas.objects import PlacedObject, PlacedObjects
from schemas.outcome import Done
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.seeding import rng_for
from tableverse_factory.geometry.collision.penetration import mesh_penetrations
from tableverse_factory.geometry.convex.decompose import decompose
from tableverse_factory.geometry.math.transforms import normalized_quaternion
from tableverse_factory.geometry.relations.preserved import Relations, relations_of
from tableverse_factory.models.services import Services
from tableverse_factory.stages.observe.observe import read_layout
from tableverse_factory.stages.rectify.groups import Group
from tableverse_factory.stages.rectify.lccr import lccr
from tableverse_factory.stages.rectify.radial import azimuths
from tableverse_factory.stages.rectify.rigid_part import RigidPart, part_of

Item = TypeVar("Item")

CROSSING_M = 0.001
"""Where meshes overlap by more than this in a truth, as a certificate counts a collision, no result that is free of
collisions can have the two as they are there [m]."""

Truth = dict[str, tuple[Pose, float]]
"""Pose and scale of each object at which it truly rests."""


class _Rest(LayoutPose):
    scale: float = 1.0


_TRUTH = TypeAdapter(dict[str, _Rest])


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """One layout with all that its results are compared with.

    Attributes:
        name: File name without its ending.
        item: The layout as observed.
        pieces: Of each object.
        truth: Of the objects whose rest is known; empty where there is none.
        relations: Those of the truth, if it is known for every object.
        groups: LCCR's groups in the observed layout, the root first.
        azimuths: Their directions about the root [rad].
    """

    name: str
    item: PlacedObjects
    pieces: tuple[ConvexPieces, ...]
    truth: Truth
    relations: Relations | None
    groups: tuple[Group, ...]
    azimuths: Float64[np.ndarray, " n"]

    def azimuth_changes(self, poses: Mapping[str, Pose]) -> Float64[np.ndarray, " k"]:
        """Turn of each group but the root about the root [rad], of objects at poses by their ids; NaN at the centre."""
        objects = self.item.objects
        at = [poses.get(placed.object_id, placed.pose) for placed in objects]
        change = azimuths(parts_at(objects, self.pieces, at), self.groups)[1:] - self.azimuths[1:]
        turned: Float64[np.ndarray, " k"] = (change + np.pi) % (2 * np.pi) - np.pi
        return turned


def parts_at(objects: Sequence[PlacedObject], pieces: Sequence[ConvexPieces], poses: Sequence[Pose]) -> list[RigidPart]:
    """Objects as rectification sees them, at poses of the table frame."""
    return [part_of(replace(placed, pose=pose), its) for placed, pose, its in zip(objects, poses, pieces, strict=True)]


def layout_files(path: Path, most: int | None) -> list[Path]:
    """The layouts of a folder in the order of their names, at most so many, spread evenly; or the one file given.

    Raises:
        InputError: if the folder holds none.
    """
    found = [path] if path.is_file() else sorted(path.glob("*.json"))
    if not found:
        raise InputError(f"{path} holds no layout: give a folder of *.json files", "no_layouts")
    return spread_out(found, most)


def spread_out(items: Sequence[Item], most: int | None) -> list[Item]:
    """At most so many of the items, spread evenly from the first to the last."""
    if most is None or len(items) <= most:
        return list(items)
    return [items[index] for index in np.linspace(0, len(items) - 1, most).round().astype(int).tolist()]


def read_case(path: Path, truth: Path | None, config: Config, cache_dir: Path) -> Case:
    """A layout, its pieces and its truth.

    Args:
        path: The layout file.
        truth: Folder with a file of the same name: object id to position, quaternion_wxyz, scale.
        config: Of the run.
        cache_dir: Where convex pieces are kept.

    Raises:
        InputError: if the layout or its truth cannot be read.
        GeometryError: if a mesh cannot be decomposed.
    """
    item = _read_layout(path, config)
    pieces = tuple(decompose(placed.mesh, config.rectify, cache_dir) for placed in item.objects)
    rests = _read_truth(truth / path.name) if truth else {}
    parts = parts_at(item.objects, pieces, [placed.pose for placed in item.objects])
    groups = lccr(parts, config.rectify).groups
    relations = _true_relations(item.objects, pieces, rests)
    return Case(path.stem, item, pieces, rests, relations, groups, azimuths(parts, groups))


def _true_relations(objects: Sequence[PlacedObject], pieces: Sequence[ConvexPieces], rests: Truth) -> Relations | None:
    """Who carries and holds whom in the truth; not of things that pass through one another there."""
    if any(placed.object_id not in rests for placed in objects):
        return None
    poses, scales = zip(*(rests[placed.object_id] for placed in objects), strict=True)
    depths = mesh_penetrations([placed.mesh for placed in objects], poses, scales)
    crossing = frozenset((i, j) for i, j, depth in depths if depth > CROSSING_M)
    return relations_of(objects, pieces, poses, scales).without(crossing)


def _read_layout(path: Path, config: Config) -> PlacedObjects:
    row = ImageRow(scene_id="bench", kind=SceneKind.LAYOUT, uri=str(path))
    outcome = read_layout(row, config, rng_for(0, path.stem, "bench"), Services(Path()))
    if not isinstance(outcome, Done):
        raise InputError(f"{path.name}: {outcome}", "bad_layout")
    return outcome.value


def _read_truth(path: Path) -> Truth:
    try:
        rests = _TRUTH.validate_json(path.read_bytes())
    except OSError as error:
        raise InputError(f"truth {path.name}: {error.strerror}: give a file for every layout", "bad_truth") from error
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(map(str, first["loc"]))
        raise InputError(f"truth {path.name}: {where}: {first['msg']}", "bad_truth") from error
    return {
        name: (Pose(np.array(rest.position), normalized_quaternion(np.array(rest.quaternion_wxyz))), rest.scale)
        for name, rest in rests.items()
    }
