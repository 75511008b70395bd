"""Input layouts of `bench lccr`: observed poses, convex pieces, true rest poses and relations."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

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
from tableverse_factory.core.seeding import make_rng
from tableverse_factory.evaluation.bench.measurement import sample_evenly
from tableverse_factory.geometry.collision.penetration import measure_mesh_penetrations
from tableverse_factory.geometry.convex.decompose import decompose
from tableverse_factory.geometry.math.transforms import normalize_quaternion
from tableverse_factory.geometry.relations.preserved import Relations, find_relations
from tableverse_factory.models.services import Services
from tableverse_factory.sources.discovery import is_source_file
from tableverse_factory.stages.observe.observe import read_layout
from tableverse_factory.stages.rectify.groups import Group
from tableverse_factory.stages.rectify.lccr import rectify_lccr
from tableverse_factory.stages.rectify.radial import compute_azimuths
from tableverse_factory.stages.rectify.rigid_part import RigidPart, make_rigid_part

CROSSING_M = 0.001
"""Meshes that overlap by more than this in the truth collide there: no collision-free result can repeat it [m]."""

RestPoses = dict[str, tuple[Pose, float]]  # true pose and scale of each object at rest


class _RestPose(LayoutPose):
    scale: float = 1.0


_REST_POSES = TypeAdapter(dict[str, _RestPose])


@dataclass(frozen=True, slots=True, eq=False)
class LayoutCase:
    """A layout and the references of its results."""

    name: str  # file name without its suffix
    item: PlacedObjects  # as observed
    pieces: tuple[ConvexPieces, ...]  # of each object
    truth: RestPoses  # of the objects for which it is known
    relations: Relations | None  # true ones; None unless the rest of every object is known
    groups: tuple[Group, ...]  # LCCR's groups in the observed layout, the root first
    azimuths: Float64[np.ndarray, " n"]  # directions of the groups about the root [rad]

    def azimuth_changes(self, poses: Mapping[str, Pose]) -> Float64[np.ndarray, " k"]:
        """Compute the turn of each group about the root [rad], for objects at poses by id; NaN at the centre."""
        objects = self.item.objects
        at = [poses.get(placed.object_id, placed.pose) for placed in objects]
        change = compute_azimuths(make_parts(objects, self.pieces, at), self.groups)[1:] - self.azimuths[1:]
        return (change + np.pi) % (2 * np.pi) - np.pi


def make_parts(
    objects: Sequence[PlacedObject], pieces: Sequence[ConvexPieces], poses: Sequence[Pose]
) -> list[RigidPart]:
    """Build the rigid parts of rectification from objects at poses in the table frame."""
    return [
        make_rigid_part(replace(placed, pose=pose), its)
        for placed, pose, its in zip(objects, poses, pieces, strict=True)
    ]


def find_layouts(path: Path, most: int | None) -> list[Path]:
    """Find the layouts of a folder by name, at most `most`, spread evenly; or return the one file."""
    inside = (file for file in path.glob("*.json") if not is_source_file(file.name))
    found = [path] if path.is_file() else sorted(inside)
    if not found:
        raise InputError(f"{path} holds no layout: give a folder of *.json files", "no_layouts")
    return sample_evenly(found, most)


def read_case(path: Path, truth: Path | None, config: Config, cache_dir: Path) -> LayoutCase:
    """Read a layout and decompose its meshes; the folder `truth` has a file of the same name with the rest poses."""
    item = _read_layout(path, config)
    pieces = tuple(decompose(placed.mesh, config.rectify, cache_dir) for placed in item.objects)
    rests = _read_rest_poses(truth / path.name) if truth else {}
    parts = make_parts(item.objects, pieces, [placed.pose for placed in item.objects])
    groups = rectify_lccr(parts, config.rectify).groups
    relations = _find_true_relations(item.objects, pieces, rests)
    return LayoutCase(path.stem, item, pieces, rests, relations, groups, compute_azimuths(parts, groups))


def _find_true_relations(
    objects: Sequence[PlacedObject], pieces: Sequence[ConvexPieces], rests: RestPoses
) -> Relations | None:
    """Find support and containment in the truth, without pairs of objects that collide there."""
    if any(placed.object_id not in rests for placed in objects):
        return None
    poses, scales = zip(*(rests[placed.object_id] for placed in objects), strict=True)
    depths = measure_mesh_penetrations([placed.mesh for placed in objects], poses, scales)
    crossing = frozenset((i, j) for i, j, depth in depths if depth > CROSSING_M)
    return find_relations(objects, pieces, poses, scales).without(crossing)


def _read_layout(path: Path, config: Config) -> PlacedObjects:
    row = ImageRow(scene_id="bench", kind=SceneKind.LAYOUT, uri=str(path))
    outcome = read_layout(row, config, make_rng(0, path.stem, "bench"), Services(Path()))
    if not isinstance(outcome, Done):
        raise InputError(f"{path.name}: {outcome}", "bad_layout")
    return outcome.value


def _read_rest_poses(path: Path) -> RestPoses:
    try:
        rests = _REST_POSES.validate_json(path.read_bytes())
    except OSError as error:
        raise InputError(f"truth {path.name}: {error.strerror}: give a file for every layout", "bad_truth") from error
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(map(str, first["loc"]))
        raise InputError(f"truth {path.name}: {where}: {first['msg']}", "bad_truth") from error
    return {
        name: (Pose(np.array(rest.position), normalize_quaternion(np.array(rest.quaternion_wxyz))), rest.scale)
        for name, rest in rests.items()
    }
