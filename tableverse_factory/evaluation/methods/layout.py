"""Comparison of layouts with the truth: positions, sizes, headings, support and containment."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.optimize import linear_sum_assignment

from schemas.config import RectifyConfig
from schemas.geometry import TriangleMesh, Vector3
from schemas.objects import PlacedObject
from tableverse_factory.core.errors import TableverseError
from tableverse_factory.evaluation.methods.heading import (
    compute_heading_error,
    compute_heading_error_of_same,
    compute_twist_about_z,
)
from tableverse_factory.evaluation.methods.scenes import MethodObject, MethodScene, SceneSource
from tableverse_factory.evaluation.methods.truth import ReadTruth, SceneTruth
from tableverse_factory.geometry.convex.decompose import decompose
from tableverse_factory.geometry.math.aabb import aabb
from tableverse_factory.geometry.math.transforms import conjugate_quaternion, multiply_quaternions, transform_points
from tableverse_factory.geometry.mesh.hulls import compute_hull_volume
from tableverse_factory.geometry.mesh.meshes import box_center, place_mesh
from tableverse_factory.geometry.relations.preserved import (
    PreservedRelations,
    Relations,
    compare_relations,
    find_relations,
)

NO_RESULT = "not among the results"  # error of a scene that has a truth and no result

SAME_PLACE = 0.6  # without names, objects match within this share of the diagonal of the true box


@dataclass(frozen=True, slots=True)
class ObjectMatch:
    """A true object and its match in the result.

    The boxes are the mesh's own if both sides have the same mesh, as in the certificate and in `bench lccr`; else those
    along the axes of the table.
    """

    name: str  # of the true object
    found: str = ""  # name of the match; empty without one, and then there are no errors
    position_error_m: float = float("nan")  # between the centres of the boxes [m]
    size_error: float = float("nan")  # cube root of the ratio of the convex hulls' volumes, less 1
    heading_error_rad: float | None = None  # about the vertical up to symmetries; None for a round shape [rad]


@dataclass(frozen=True, slots=True)
class SceneLayout:
    """Comparison of one scene."""

    name: str
    matches: tuple[ObjectMatch, ...] = ()  # one per true object
    extra: tuple[str, ...] = ()  # names of objects of the result without a true object
    kept: PreservedRelations = field(default_factory=PreservedRelations)  # true relations, and those that hold
    error: str = ""  # why the scene could not be compared, or empty


def compare_layouts(
    results: Mapping[str, SceneSource], truths: Mapping[str, ReadTruth], cache_dir: Path
) -> tuple[SceneLayout, ...]:
    """Compare every scene with a truth; all objects of a scene without a readable result are missing."""
    compared = []
    for name, read_truth in sorted(truths.items()):
        if name not in results:
            compared.append(_make_missing(name, read_truth, NO_RESULT))
            continue
        try:
            result = results[name].read()
            compared.append(compare_scene(name, result, read_truth(result), cache_dir))
        except TableverseError as error:
            compared.append(_make_missing(name, read_truth, str(error)))
    return tuple(compared)


def _make_missing(name: str, read_truth: ReadTruth, error: str) -> SceneLayout:
    """Make the comparison of a scene without a result, with no object found."""
    try:
        truth = read_truth(MethodScene(()))
    except TableverseError as worse:
        return SceneLayout(name, error=f"{error}; {worse}" if str(worse) != error else error)
    names = (*(item.name for item in truth.objects), *truth.missing)
    return SceneLayout(name, tuple(map(ObjectMatch, names)), error=error)


def compare_scene(name: str, result: MethodScene, truth: SceneTruth, cache_dir: Path) -> SceneLayout:
    """Compare one scene with its truth; raise a `GeometryError` if a mesh cannot be cut into convex pieces."""
    named: dict[str, MethodObject | None] = {item.name: item for item in result.objects}
    pairs = [named.get(true.name) for true in truth.objects] if truth.named else _match_by_position(result, truth)
    used = {item.name for item in pairs if item is not None}
    matches = [
        ObjectMatch(true.name) if found is None else _measure_match(true, found, truth.same_meshes)
        for true, found in zip(truth.objects, pairs, strict=True)
    ]
    return SceneLayout(
        name,
        (*matches, *(ObjectMatch(missing) for missing in truth.missing)),
        tuple(item.name for item in result.objects if item.name not in used),
        compare_relations(find_object_relations(truth.objects, cache_dir), find_object_relations(pairs, cache_dir)),
    )


def summarize_layouts(scenes: Sequence[SceneLayout]) -> dict[str, float | None]:
    """Summarize scenes by row of the table; None where nothing was measured.

    Objects of missing scenes count as not found; errors and relations are those of the scenes compared.
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
        "found [%]": compute_percent(len(found), len(matches)),
        "extra objects": sum(len(scene.extra) for scene in sound),
        "position, median [mm]": _compute_percentile(position, 50.0),
        "position, p90 [mm]": _compute_percentile(position, 90.0),
        "size, median [%]": _compute_percentile(size, 50.0),
        "size, p90 [%]": _compute_percentile(size, 90.0),
        "objects with a heading": len(turned),
        "heading, median [°]": _compute_percentile(turned, 50.0),
        "heading, p90 [°]": _compute_percentile(turned, 90.0),
        "support relations": relations.carried,
        "support kept [%]": compute_percent(relations.carried_kept, relations.carried),
        "containment relations": relations.contained,
        "containment kept [%]": compute_percent(relations.contained_kept, relations.contained),
    }


def _match_by_position(result: MethodScene, truth: SceneTruth) -> list[MethodObject | None]:
    """Assign objects by least total distance between boxes, without pairs that are too far apart.

    The distance is the mean of those of the lowest and the highest corners, so a content does not match its bowl.
    """
    standing = [np.stack(aabb(_place_object(item).vertices)) for item in result.objects]
    true = [np.stack(aabb(_place_object(item).vertices)) for item in truth.objects]
    distance = np.array([[float(np.linalg.norm(a - b, axis=1).mean()) for b in standing] for a in true])
    reach = np.array([SAME_PLACE * float(np.linalg.norm(high - low)) for low, high in true])
    pairs: list[MethodObject | None] = [None] * len(true)
    if not distance.size:
        return pairs
    # Beyond its reach a pair has a constant cost, so that it never breaks another pair.
    for i, j in zip(*linear_sum_assignment(np.minimum(distance, reach[:, None])), strict=True):
        if distance[i, j] < reach[i]:
            pairs[int(i)] = result.objects[int(j)]
    return pairs


def _measure_match(true: MethodObject, found: MethodObject, same_meshes: bool) -> ObjectMatch:
    true_mesh, mesh = _place_object(true), _place_object(found)
    volumes = compute_hull_volume(mesh.vertices), compute_hull_volume(true_mesh.vertices)
    size = float(np.cbrt(volumes[0] / volumes[1])) - 1.0 if min(volumes) > 0.0 else float("nan")
    if same_meshes:
        back = conjugate_quaternion(true.pose.quaternion_wxyz)
        turned = compute_twist_about_z(multiply_quaternions(found.pose.quaternion_wxyz, back))
        heading = compute_heading_error_of_same(true_mesh, turned)
        shift = float(np.linalg.norm(_compute_own_center(found) - _compute_own_center(true)))
    else:
        heading = compute_heading_error(mesh, true_mesh)
        shift = float(np.linalg.norm(box_center(mesh) - box_center(true_mesh)))
    return ObjectMatch(true.name, found.name, shift, size, heading)


def find_object_relations(items: Sequence[MethodObject | None], cache_dir: Path) -> Relations:
    """Find relations by index in the list; missing objects have none."""
    present = [(index, item) for index, item in enumerate(items) if item is not None]
    poses, scales = [item.pose for _, item in present], [item.scale for _, item in present]
    pieces = [item.pieces or decompose(item.mesh, RectifyConfig(), cache_dir) for _, item in present]
    objects = [PlacedObject(item.name, "", 1.0, item.mesh, item.scale, item.pose) for _, item in present]
    found = find_relations(objects, pieces, poses, scales)
    carried, on_pieces, contained = (
        frozenset((present[i][0], present[j][0]) for i, j in pairs)
        for pairs in (found.carried, found.carried_on_pieces, found.contained)
    )
    return Relations(carried, on_pieces, contained)


def _place_object(item: MethodObject) -> TriangleMesh:
    return place_mesh(item.mesh, item.pose, item.scale)


def _compute_own_center(item: MethodObject) -> Vector3:
    """Compute the centre of the mesh's own box in the scene [m], which turning the object does not move."""
    return transform_points(item.pose, box_center(item.mesh)[None], item.scale)[0]


def _compute_percentile(values: Sequence[float], percent: float) -> float | None:
    sound = [value for value in values if np.isfinite(value)]
    return float(np.percentile(sound, percent)) if sound else None


def compute_percent(some: int, of: int) -> float | None:
    """Compute a share [%]; None of nothing."""
    return 100.0 * some / of if of else None
