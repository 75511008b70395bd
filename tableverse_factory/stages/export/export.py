"""The stage `export`: MJCF with its assets, the certificate measured on those files, and the rows of the tables."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from schemas.config import Config, ExportConfig
from schemas.geometry import Pose
from schemas.objects import PlacedObject
from schemas.outcome import Done, Dropped, Outcome
from schemas.scene import Certificate, CuratedScene, ExportedScene, RectifiedLayout
from tableverse_factory.core.errors import GeometryError, TableverseError
from tableverse_factory.geometry.math.aabb import aabb_size
from tableverse_factory.geometry.math.camera import PosedCamera
from tableverse_factory.models.services import Services
from tableverse_factory.physics.bodies.materials import estimate_mass_kg
from tableverse_factory.physics.bodies.prior_mass import apply_material_friction
from tableverse_factory.physics.mjcf.pose_history import PoseHistory
from tableverse_factory.physics.mjcf.slab import Slab, fit_slab
from tableverse_factory.physics.mjcf.spec import (
    Backdrop,
    SceneBody,
    SceneFiles,
    TableTexture,
    make_scene_body,
    make_scene_files,
    quantize_pose,
)
from tableverse_factory.physics.simulate.certificate import Measurement, certify
from tableverse_factory.physics.simulate.settle_bodies import bring_to_rest, increase_rolling_friction, move_bodies
from tableverse_factory.physics.simulate.sizes import SimulationSizes, measure_sizes
from tableverse_factory.sources.textures.catalogue import TILE_M
from tableverse_factory.stages.export.fidelity import describe_fidelity
from tableverse_factory.stages.export.meta import build_meta_json
from tableverse_factory.stages.export.projected_color import ColorProjector, load_projectors
from tableverse_factory.stages.export.rows import build_object_rows, build_scene_row, build_task_rows
from tableverse_factory.stages.export.surroundings import photograph_backdrop, photograph_table
from tableverse_factory.stages.export.tabletop import draw_tabletop_texture
from tableverse_factory.stages.export.texture import bake_texture

SETTLINGS = 3  # most rounds of settling of a scene that still drifts
MASS_STEP_KG = 1e-5  # greatest difference of masses that needs no new settling [kg]: judges round masses
# Colours of meshes that come without.
PALETTE = ((196, 102, 92), (98, 140, 184), (128, 166, 104), (214, 170, 88), (150, 120, 170), (92, 160, 158))


def export(
    scene: CuratedScene,
    config: Config,
    rng: np.random.Generator,
    services: Services,  # noqa: ARG001
) -> Outcome[ExportedScene]:
    """Write the scene with the judged masses, settle it with them, and certify the written files.

    No scene with a penetration deeper than `export.epsilon_m` or with motion is exported, unless `export.poses` asks
    for one that was not settled. Drops: `unusable_mesh`, `simulation_unstable`, `object_fell`, `not_at_rest`,
    `colliding`.
    """
    layout = scene.settled.rectified
    try:
        bodies = _build_bodies(scene, config.export)
    except GeometryError as error:
        return Dropped("unusable_mesh", str(error))
    objects = layout.placed.objects
    slab = fit_slab(layout.placed.table, [o.mesh for o in objects], layout.poses, [o.scale for o in objects])
    written = _settle_and_certify(scene, bodies, slab, _dress(scene, slab, config, rng), config)
    if (reason := _explain_refusal(written, config.export)) is not None:
        return reason
    return Done(_assemble(scene, written))


@dataclass(frozen=True, slots=True)
class _Scenery:
    """Looks of what is not an object."""

    tabletop: TableTexture
    backdrop: Backdrop | None = None


def _dress(scene: CuratedScene, slab: Slab, config: Config, rng: np.random.Generator) -> _Scenery:
    evidence = scene.settled.rectified.placed.evidence
    if config.export.surroundings == "photograph" and evidence is not None:
        return _Scenery(photograph_table(evidence, slab), photograph_backdrop(evidence, slab))
    return _Scenery(TableTexture(draw_tabletop_texture(rng, slab.color), (TILE_M, TILE_M)))


@dataclass(frozen=True, slots=True)
class _CertifiedFiles:
    """A scene's files with their certificate and measurements."""

    bodies: tuple[SceneBody, ...]
    files: SceneFiles
    certificate: Certificate
    measured: Measurement
    sizes: SimulationSizes


def _choose_poses(scene: CuratedScene, export: ExportConfig) -> Sequence[Pose]:
    """Choose the poses of `export.poses`; a copy, which no picture shows, is placed by rectification."""
    layout = scene.settled.rectified
    if export.poses == "settled":
        return scene.settled.poses
    if export.poses == "rectified":
        return layout.poses
    items = zip(layout.placed.objects, layout.poses, strict=True)
    return [rectified if item.copy_of else item.pose for item, rectified in items]


def _build_bodies(scene: CuratedScene, export: ExportConfig) -> tuple[SceneBody, ...]:
    layout = scene.settled.rectified
    masses = {verdict.object_id: verdict.mass_kg for verdict in scene.assessment.objects}
    objects, evidence = layout.placed.objects, layout.placed.evidence
    pictures: Sequence[ColorProjector | None] = [None] * len(objects)
    if evidence is not None:
        pictures = load_projectors(evidence, [item.pose for item in objects], [item.scale for item in objects])
    bodies, poses = [], _choose_poses(scene, export)
    for index, (item, pieces) in enumerate(zip(objects, layout.pieces, strict=True)):
        if item.object_id not in masses:
            raise TableverseError(f"{scene.scene_id}: the assessment has no mass for {item.object_id}")
        pose = quantize_pose(poses[index])
        body = make_scene_body(item.object_id, item.mesh, pieces.hulls, item.scale, masses[item.object_id], pose)
        looks = replace(body, color=PALETTE[index % len(PALETTE)], appearance=bake_texture(item.mesh, pictures[index]))
        bodies.append(apply_material_friction(item.label, looks))
    return tuple(bodies)


def _settle_and_certify(
    scene: CuratedScene, bodies: Sequence[SceneBody], slab: Slab, scenery: _Scenery, config: Config
) -> _CertifiedFiles:
    """Write the scene and settle it until the certificate finds it at rest, at most `SETTLINGS` times."""
    layout, step, limit = scene.settled.rectified, config.settle.timestep_s, config.settle.max_time_s
    history, seen = _build_history(layout), layout.placed.evidence
    view = None if seen is None else PosedCamera(seen.camera, seen.camera_to_table)
    settles = config.export.poses == "settled"
    rests = not settles or all(map(_has_settled_mass, layout.placed.objects, bodies))
    for attempt in range(SETTLINGS):
        if not rests:
            bodies, _ = bring_to_rest(bodies, slab, timestep_s=step, max_time_s=limit, gentle=attempt > 0)
        files = make_scene_files(
            *(bodies, slab),
            model_name=scene.scene_id,
            timestep_s=step,
            view=view,
            tabletop=scenery.tabletop,
            backdrop=scenery.backdrop,
        )
        model = files.model()
        certificate, measured = certify(model, history, config.export.epsilon_m)
        last = attempt == SETTLINGS - 1
        if last or not settles or certificate.at_rest or certificate.fell or measured.warnings:
            break
        bodies, rests = increase_rolling_friction(move_bodies(bodies, measured.end_poses), set(measured.moved)), False
    return _CertifiedFiles(tuple(bodies), files, certificate, measured, measure_sizes(model))


def _has_settled_mass(item: PlacedObject, body: SceneBody) -> bool:
    """Whether the object has already settled with the judge's mass."""
    prior = estimate_mass_kg(item.label, body.properties.volume_m3, aabb_size(body.mesh.vertices))
    return abs(body.properties.mass_kg - prior) <= MASS_STEP_KG


def _build_history(layout: RectifiedLayout) -> PoseHistory:
    objects = layout.placed.objects
    return PoseHistory(
        placed={item.object_id: item.pose for item in objects if item.copy_of is None},
        rectified={item.object_id: pose for item, pose in zip(objects, layout.poses, strict=True)},
        contained_in={item.object_id: item.contained_in for item in objects if item.contained_in},
    )


def _explain_refusal(written: _CertifiedFiles, export: ExportConfig) -> Dropped | None:
    certificate, measured = written.certificate, written.measured
    if measured.warnings:
        return Dropped("simulation_unstable", f"MuJoCo warned of {', '.join(measured.warnings)}")
    if export.poses != "settled":
        return None
    if certificate.fell:
        return Dropped("object_fell", f"{', '.join(certificate.fell[:10])} fell")
    if not certificate.at_rest:
        drift = f"drift {certificate.drift_m * 1e3:.2f} mm, {np.degrees(certificate.drift_rad):.2f} deg"
        return Dropped("not_at_rest", f"{drift} in 5 s: {', '.join(measured.moved[:10])}")
    if certificate.colliding:
        pieces, meshes = (f"{depth * 1e3:.2f} mm ({pair})" for depth, pair in (measured.pieces, measured.meshes))
        return Dropped("colliding", f"deeper than {export.epsilon_m * 1e3:g} mm: pieces {pieces}, meshes {meshes}")
    return None


def _assemble(scene: CuratedScene, written: _CertifiedFiles) -> ExportedScene:
    members = {"scene.xml": written.files.xml.encode(), **written.files.assets}
    evidence = scene.settled.rectified.placed.evidence
    if evidence is not None:
        members["observation/color.jpg"] = evidence.color_jpg
        members["observation/masks.png"] = evidence.masks_png
    fidelity = describe_fidelity(scene, written.bodies)
    rows = build_object_rows(scene, written.bodies, written.certificate)
    members["meta.json"] = build_meta_json(scene, written.bodies, written.certificate, fidelity, members)
    return ExportedScene(
        scene.scene_id,
        tuple(sorted(members.items())),
        written.certificate,
        {**build_scene_row(scene, written.certificate, written.sizes), **fidelity.scene},
        tuple({**row, **columns} for row, columns in zip(rows, fidelity.objects, strict=True)),
        build_task_rows(scene),
    )
