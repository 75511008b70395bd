"""Input of a judge: the settled objects in the table frame, with their measurements."""

from dataclasses import dataclass, replace

import numpy as np

from schemas.config import CurateConfig
from schemas.geometry import Pose, TriangleMesh
from schemas.objects import PlacedObject, Table
from schemas.scene import SettledScene
from tableverse_factory.geometry.math.aabb import aabb, aabb_size
from tableverse_factory.geometry.mesh.height_maps import CELL_M
from tableverse_factory.geometry.mesh.meshes import box_center, concatenate_meshes, place_mesh
from tableverse_factory.geometry.mesh.raycasting import make_raycasting_scene
from tableverse_factory.geometry.relations.antipodal import Grips, filter_grips, find_antipodal_grips
from tableverse_factory.geometry.relations.relations import BodyFeatures, compute_body_features
from tableverse_factory.geometry.relations.stable_placement import make_support_surface
from tableverse_factory.physics.mjcf.shape import make_body_shape
from tableverse_factory.physics.mjcf.slab import fit_slab
from tableverse_factory.stages.curate.appearance import DescribedObject, measure_color_shares
from tableverse_factory.stages.curate.feasibility import Feasibility
from tableverse_factory.stages.curate.twin_check import TwinCheck, check_twin

_MAX_CELLS = 400  # most cells along the longer side of the layout: huge layouts get coarser maps


@dataclass(frozen=True, slots=True, eq=False)
class JudgedObject(DescribedObject):
    """One object of the scene, its mesh settled, in the table frame [m]; judges count from 0 in the scene's order.

    `volume_m3` is that of the pieces where the mesh is open, `fit_residual_m` the median distance from the observed
    points, and `displacement_m` that of the centre from the placed one (0 for a copy).
    """

    object_id: str
    confidence: float
    mesh: TriangleMesh
    grips: Grips
    fit_residual_m: float
    displacement_m: float


@dataclass(frozen=True, slots=True, eq=False)
class JudgeInput:
    """One scene to judge, its table as exported; `penetration_before_m` is the deepest of the placed pieces [m].

    `twin` compares it with its photograph, which no judge can overrule.
    """

    scene_id: str
    items: tuple[JudgedObject, ...]
    table: Table
    feasibility: Feasibility
    penetration_before_m: float
    twin: TwinCheck

    @property
    def bodies(self) -> tuple[BodyFeatures, ...]:
        """The items' bodies."""
        return tuple(item.body for item in self.items)


def build_judge_input(scene: SettledScene, config: CurateConfig) -> JudgeInput:
    """Measure a settled scene."""
    placed = scene.rectified.placed
    meshes = [place_mesh(o.mesh, pose, o.scale) for o, pose in zip(placed.objects, scene.poses, strict=True)]
    extent = aabb_size(np.concatenate([corner for mesh in meshes for corner in aabb(mesh.vertices)]).reshape(-1, 3))
    cell = max(CELL_M, float(extent[:2].max()) / _MAX_CELLS)
    items = tuple(
        _measure_object(o, mesh, tuple(pieces.hulls), pose, cell, config.gripper_width_m)
        for o, mesh, pieces, pose in zip(placed.objects, meshes, scene.rectified.pieces, scene.poses, strict=True)
    )
    slab = fit_slab(placed.table, [o.mesh for o in placed.objects], scene.poses, [o.scale for o in placed.objects])
    table = replace(placed.table, center_xy=slab.center_xy, half_size_xy=slab.half_size_xy)
    top = make_support_surface(tuple(item.body for item in items), table, cell)
    feasibility = Feasibility(tuple(meshes), tuple(item.grips for item in items), top, config.max_grasp_mass_kg)
    twin = check_twin(scene, tuple(meshes))
    return JudgeInput(scene.scene_id, items, table, feasibility, scene.rectified.penetration_before_m, twin)


def _measure_object(
    item: PlacedObject, mesh: TriangleMesh, hulls: tuple[TriangleMesh, ...], pose: Pose, cell: float, width: float
) -> JudgedObject:
    """Measure an object with its settled mesh and pose, for a gripper's opening `width` [m]."""
    low, high = aabb(item.mesh.vertices)
    before = None if item.copy_of else box_center(place_mesh(item.mesh, item.pose, item.scale))
    caster = make_raycasting_scene(mesh)
    pieces_caster = make_raycasting_scene(place_mesh(concatenate_meshes(hulls), pose, item.scale))
    return JudgedObject(
        object_id=item.object_id,
        label=item.label,
        confidence=item.label_confidence,
        mesh=mesh,
        body=compute_body_features(mesh, caster, cell),
        grips=filter_grips(find_antipodal_grips(mesh, caster, width), pieces_caster, width),
        size=np.asarray((high - low) * item.scale),
        volume_m3=make_body_shape(item.mesh, hulls, item.scale).moments.volume_m3,
        fit_residual_m=item.fit_residual_m,
        displacement_m=0.0 if before is None else float(np.linalg.norm(box_center(mesh) - before)),
        colors=measure_color_shares(mesh),
    )
