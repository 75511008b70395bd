"""Layouts against the truth: where things stand, how large they are, how they are turned, what carries what."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.optimize import linear_sum_assignment

from schemas.config import RectifyConfig
from schemas.geometry import TriangleMesh, Vector3
from schemas.objects import PlacedObject
from tableverse_factory.core.errors import TableverseError
from tableverse_factory.evaluation.methods.heading import heading_error, heading_error_of_same, twist_about_z
from tableverse_factory.evaluation.methods.scenes import MethodObject, MethodScene, Source
from tableverse_factory.evaluation.methods.truth import ReadTruth, Truth
from tableverse_factory.geometry.convex.decompose import decompose
from tableverse_factory.geometry.math.transforms import multiply_quaternions, transform_points
from tableverse_factory.geometry.mesh.hulls import hull_volume
from tableverse_factory.geometry.mesh.meshes import bounds, box_center, placed_mesh
from tableverse_factory.geometry.relations.preserved import (
    PreservedRelations,
    Relations,
    compare_relations,
    relations_of,
)

NOT_THERE = "not among the results"
"""What is said of a scene that has a truth and no result."""

SAME_PLACE = 0.6
"""Without names, a result's object can stand for a true one within this share of the true box's diagonal."""


@dataclass(frozen=True, slots=True)
class Match:
    """A true object and what the result has for it.

    Attributes:
        found: Its name in the result; empty where it is missing, and then there are no errors.
        position_error_m: Distance between the centres of the boxes [m]: of the mesh's own box where both sides have the
            same mesh, as in the certificate and in `bench lccr`; else of the boxes along the axes of the table.
        size_error: Relative error of the size: the cube root of the ratio of the convex hulls' volumes, less 1.
        heading_error_rad: About the vertical, symmetries of the true shape allowed; None for a round one [rad].
    """

    name: str
    found: str = ""
    position_error_m: float = float("nan")
    size_error: float = float("nan")
    heading_error_rad: float | None = None


@dataclass(frozen=True, slots=True)
class SceneLayout:
    """One scene.

    Attributes:
        matches: A true object each.
        extra: Names of the result's objects that stand for no true one.
        kept: True relations of support and containment, and those of them that hold in the result.
        error: Why the scene could not be compared; empty as a rule.
    """

    name: str
    matches: tuple[Match, ...] = ()
    extra: tuple[str, ...] = ()
    kept: PreservedRelations = field(default_factory=PreservedRelations)
    error: str = ""


def compare_layouts(
    results: Mapping[str, Source], truths: Mapping[str, ReadTruth], cache_dir: Path
) -> tuple[SceneLayout, ...]:
    """Every scene that has a truth; of one that the results lack, or that cannot be read, all objects are missing."""
    compared = []
    for name, read_truth in sorted(truths.items()):
        if name not in results:
            compared.append(_missing(name, read_truth, NOT_THERE))
            continue
        try:
            result = results[name].read()
            compared.append(compare_scene(name, result, read_truth(result), cache_dir))
        except TableverseError as error:
            compared.append(_missing(name, read_truth, str(error)))
    return tuple(compared)


def _missing(name: str, read_truth: ReadTruth, error: str) -> SceneLayout:
    """A scene without a result: what is truly there was not found."""
    try:
        truth = read_truth(MethodScene(()))
    except TableverseError as worse:
        return SceneLayout(name, error=f"{error}; {worse}" if str(worse) != error else error)
    names = [*(item.name for item in truth.objects), *truth.missing]
    return SceneLayout(name, tuple(Match(missing) for missing in names), error=error)


def compare_scene(name: str, result: MethodScene, truth: Truth, cache_dir: Path) -> SceneLayout:
    """One scene against its truth.

    Raises:
        GeometryError: if a mesh cannot be cut into convex pieces.
    """
    pairs = _by_name(result, truth) if truth.named else _by_place(result, truth)
    used = {item.name for item in pairs if item is not None}
    matches = [
        Match(true.name) if found is None else _measured(true, found, truth.same_meshes)
        for true, found in zip(truth.objects, pairs, strict=True)
    ]
    return SceneLayout(
        name,
        (*matches, *(Match(missing) for missing in truth.missing)),
        tuple(item.name for item in result.objects if item.name not in used),
        compare_relations(_relations(truth.objects, cache_dir), _relations(pairs, cache_dir)),
    )


def summary(scenes: Sequence[SceneLayout]) -> dict[str, float | None]:
    """What the table shows, by the names of its rows; None where there is nothing to measure.

    Objects of scenes that are missing count as not found; errors and relations are those of the scenes compared.
    """
    sound = [scene for scene in scenes if not scene.error]
    matches = [match for scene in scenes for match in scene.matches]
    found = [match for match in matches if match.found]
    turned = [np.rad2deg(m.heading_error_rad) for m in found if m.heading_error_rad is not None]
    relations = sum((scene.kept for scene in sound), PreservedRelations())
    position = [1e3 * match.position_error_m for match in found]
    size = [100.0 * abs(match.size_error) for match in found]
    return {
        "scenes": len(sound),
        "scenes missing": len(scenes) - len(sound),
        "true objects": len(matches),
        "found [%]": _ratio(len(found), len(matches)),
        "extra objects": sum(len(scene.extra) for scene in sound),
        "position, median [mm]": _percentile(position, 50.0),
        "position, p90 [mm]": _percentile(position, 90.0),
        "size, median [%]": _percentile(size, 50.0),
        "size, p90 [%]": _percentile(size, 90.0),
        "objects with a heading": len(turned),
        "heading, median [°]": _percentile(turned, 50.0),
        "heading, p90 [°]": _percentile(turned, 90.0),
        "support relations": relations.carried,
        "support kept [%]": _ratio(relations.carried_kept, relations.carried),
        "containment relations": relations.contained,
        "containment kept [%]": _ratio(relations.contained_kept, relations.contained),
    }


def _by_name(result: MethodScene, truth: Truth) -> list[MethodObject | None]:
    named = {item.name: item for item in result.objects}
    return [named.get(true.name) for true in truth.objects]


def _by_place(result: MethodScene, truth: Truth) -> list[MethodObject | None]:
    """The assignment of least total distance between boxes, without pairs that are too far apart.

    The distance is that of the lowest and the highest corners, in the mean: what lies in a bowl is not the bowl.
    """
    standing = [np.stack(bounds(_standing(item))) for item in result.objects]
    true = [np.stack(bounds(_standing(item))) for item in truth.objects]
    distance = np.array([[float(np.linalg.norm(a - b, axis=1).mean()) for b in standing] for a in true])
    reach = np.array([SAME_PLACE * float(np.linalg.norm(high - low)) for low, high in true])
    pairs: list[MethodObject | None] = [None] * len(true)
    if not distance.size:
        return pairs
    # Beyond its reach a pair costs the same however far: it never pulls another one apart.
    for i, j in zip(*linear_sum_assignment(np.minimum(distance, reach[:, None])), strict=True):
        if distance[i, j] < reach[i]:
            pairs[int(i)] = result.objects[int(j)]
    return pairs


def _measured(true: MethodObject, found: MethodObject, same_meshes: bool) -> Match:
    true_mesh, mesh = _standing(true), _standing(found)
    volumes = hull_volume(mesh.vertices), hull_volume(true_mesh.vertices)
    size = float(np.cbrt(volumes[0] / volumes[1])) - 1.0 if min(volumes) > 0.0 else float("nan")
    if same_meshes:
        back = true.pose.quaternion_wxyz * np.array([1.0, -1.0, -1.0, -1.0])
        turned = twist_about_z(multiply_quaternions(found.pose.quaternion_wxyz, back))
        heading = heading_error_of_same(true_mesh, turned)
        shift = float(np.linalg.norm(_own_center(found) - _own_center(true)))
    else:
        heading = heading_error(mesh, true_mesh)
        shift = float(np.linalg.norm(box_center(mesh) - box_center(true_mesh)))
    return Match(true.name, found.name, shift, size, heading)


def _relations(items: Sequence[MethodObject | None], cache_dir: Path) -> Relations:
    """Relations by the places in the list; what is missing has none."""
    there = [(index, item) for index, item in enumerate(items) if item is not None]
    poses, scales = [item.pose for _, item in there], [item.scale for _, item in there]
    pieces = [item.pieces or decompose(item.mesh, RectifyConfig(), cache_dir) for _, item in there]
    objects = [PlacedObject(item.name, "", 1.0, item.mesh, item.scale, item.pose) for _, item in there]
    found = relations_of(objects, pieces, poses, scales)
    carried, on_pieces, contained = (
        frozenset((there[i][0], there[j][0]) for i, j in pairs)
        for pairs in (found.carried, found.carried_on_pieces, found.contained)
    )
    return Relations(carried, on_pieces, contained)


def _standing(item: MethodObject) -> TriangleMesh:
    return placed_mesh(item.mesh, item.pose, item.scale)


def _own_center(item: MethodObject) -> Vector3:
    """Where the centre of the mesh's own box stands [m]: turning the object does not move it about."""
    center: Vector3 = transform_points(item.pose, box_center(item.mesh)[None], item.scale)[0]
    return center


def _percentile(values: Sequence[float], percent: float) -> float | None:
    sound = [value for value in values if np.isfinite(value)]
    return float(np.percentile(sound, percent)) if sound else None


def _ratio(some: int, of: int) -> float | None:
    return 100.0 * some / of if of else None
