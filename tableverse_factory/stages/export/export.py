"""EXPORT: MJCF with its assets, the certificate measured on those very files, and the rows of the tables."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from schemas.config import Config
from schemas.objects import PlacedObject
from schemas.outcome import Done, Dropped, Outcome
from schemas.scene import Certificate, CuratedScene, ExportedScene, RectifiedLayout
from tableverse_factory.core.errors import GeometryError, TableverseError
from tableverse_factory.geometry.math.aabb import size_around
from tableverse_factory.models.services import Services
from tableverse_factory.physics.bodies.materials import estimate_mass_kg
from tableverse_factory.physics.bodies.prior_mass import with_friction_of
from tableverse_factory.physics.mjcf.pose_history import History
from tableverse_factory.physics.mjcf.slab import Slab, slab_under
from tableverse_factory.physics.mjcf.spec import PhotoCamera, SceneBody, SceneFiles, Tabletop, scene_body, scene_files
from tableverse_factory.physics.simulate.certificate import Measurement, certify
from tableverse_factory.physics.simulate.settle_bodies import bring_to_rest, moved_to, with_more_rolling_friction
from tableverse_factory.sources.textures.catalogue import TILE_M
from tableverse_factory.stages.export.meta import meta_json
from tableverse_factory.stages.export.projected_color import ColorProjector, photographs
from tableverse_factory.stages.export.rows import object_rows, scene_row, task_rows
from tableverse_factory.stages.export.tabletop import tabletop_png
from tableverse_factory.stages.export.texture import bake

SETTLINGS = 3
"""How often a scene that still drifts may go on settling before it is given up."""

MASS_STEP_KG = 1e-5
"""Judges round masses; what differs by less stands as it stood."""

PALETTE = ((196, 102, 92), (98, 140, 184), (128, 166, 104), (214, 170, 88), (150, 120, 170), (92, 160, 158))
"""For meshes that come without colours."""


def export(
    scene: CuratedScene,
    config: Config,
    rng: np.random.Generator,
    services: Services,  # noqa: ARG001
) -> Outcome[ExportedScene]:
    """Writes the scene with the predicted masses, lets it come to rest on them, and certifies what it wrote.

    Nothing deeper than `export.epsilon_m` and nothing that moves leaves the factory. Dropped: `unusable_mesh`,
    `simulation_unstable`, `object_fell`, `not_at_rest`, `colliding`.
    """
    layout = scene.settled.rectified
    try:
        bodies = _bodies(scene)
    except GeometryError as error:
        return Dropped("unusable_mesh", str(error))
    objects = layout.placed.objects
    slab = slab_under(layout.placed.table, [o.mesh for o in objects], layout.poses, [o.scale for o in objects])
    tabletop = Tabletop(tabletop_png(rng, slab.color), TILE_M)
    written = _certified(scene, bodies, slab, tabletop, config)
    if (reason := _refusal(written, config.export.epsilon_m)) is not None:
        return reason
    return Done(_exported(scene, written))


@dataclass(frozen=True, slots=True)
class _Written:
    """A scene's files with what was measured on them."""

    bodies: tuple[SceneBody, ...]
    files: SceneFiles
    certificate: Certificate
    measured: Measurement


def _bodies(scene: CuratedScene) -> tuple[SceneBody, ...]:
    layout = scene.settled.rectified
    masses = {verdict.object_id: verdict.mass_kg for verdict in scene.assessment.objects}
    pictures = _photographs(layout)
    bodies = []
    for index, (item, pieces) in enumerate(zip(layout.placed.objects, layout.pieces, strict=True)):
        if item.object_id not in masses:
            raise TableverseError(f"{scene.scene_id}: the assessment has no mass for {item.object_id}")
        pose = scene.settled.poses[index]
        body = scene_body(item.object_id, item.mesh, pieces.hulls, item.scale, masses[item.object_id], pose)
        looks = replace(body, color=PALETTE[index % len(PALETTE)], appearance=bake(item.mesh, pictures[index]))
        bodies.append(with_friction_of(item.label, looks))
    return tuple(bodies)


def _photographs(layout: RectifiedLayout) -> Sequence[ColorProjector | None]:
    objects, evidence = layout.placed.objects, layout.placed.evidence
    if evidence is None:
        return [None] * len(objects)
    return photographs(evidence, [item.pose for item in objects], [item.scale for item in objects])


def _certified(
    scene: CuratedScene, bodies: Sequence[SceneBody], slab: Slab, tabletop: Tabletop, config: Config
) -> _Written:
    """The files of the scene at rest, settled on until the certificate agrees or patience ends."""
    layout, step = scene.settled.rectified, config.settle.timestep_s
    history = _history(layout)
    rests = all(map(_weighs_as_settled, layout.placed.objects, bodies))
    for attempt in range(SETTLINGS):
        if not rests:
            bodies, _ = bring_to_rest(
                bodies, slab, timestep_s=step, max_time_s=config.settle.max_time_s, gentle=attempt > 0
            )
        files = scene_files(
            bodies, slab, model_name=scene.scene_id, timestep_s=step, view=_view(layout), tabletop=tabletop
        )
        certificate, measured = certify(files.model(), history, config.export.epsilon_m)
        if certificate.at_rest or certificate.fell or measured.warnings:
            break
        bodies, rests = with_more_rolling_friction(moved_to(bodies, measured.end_poses), set(measured.moved)), False
    return _Written(tuple(bodies), files, certificate, measured)


def _weighs_as_settled(item: PlacedObject, body: SceneBody) -> bool:
    """Whether the judge's mass is the one with which the object came to rest in the stage before."""
    prior = estimate_mass_kg(item.label, body.properties.volume_m3, size_around(body.mesh.vertices))
    return abs(body.properties.mass_kg - prior) <= MASS_STEP_KG


def _history(layout: RectifiedLayout) -> History:
    objects = layout.placed.objects
    return History(
        placed={item.object_id: item.pose for item in objects if item.copy_of is None},
        rectified={item.object_id: pose for item, pose in zip(objects, layout.poses, strict=True)},
        contained_in={item.object_id: item.contained_in for item in objects if item.contained_in},
    )


def _view(layout: RectifiedLayout) -> PhotoCamera | None:
    evidence = layout.placed.evidence
    return None if evidence is None else PhotoCamera(evidence.camera, evidence.camera_to_table)


def _refusal(written: _Written, epsilon_m: float) -> Dropped | None:
    """Why the scene may not leave, or None."""
    certificate, measured = written.certificate, written.measured
    if measured.warnings:
        return Dropped("simulation_unstable", f"MuJoCo warned of {', '.join(measured.warnings)}")
    if certificate.fell:
        return Dropped("object_fell", f"{', '.join(certificate.fell[:10])} fell")
    if not certificate.at_rest:
        return Dropped(
            "not_at_rest",
            f"drift {certificate.drift_m * 1e3:.2f} mm, {np.degrees(certificate.drift_rad):.2f} deg "
            f"in 5 s: {', '.join(measured.moved[:10])}",
        )
    if certificate.colliding:
        return Dropped(
            "colliding",
            f"deeper than {epsilon_m * 1e3:g} mm: pieces {measured.pieces[0] * 1e3:.2f} mm ({measured.pieces[1]}), "
            f"meshes {measured.meshes[0] * 1e3:.2f} mm ({measured.meshes[1]})",
        )
    return None


def _exported(scene: CuratedScene, written: _Written) -> ExportedScene:
    members = {"scene.xml": written.files.xml.encode(), **written.files.assets}
    evidence = scene.settled.rectified.placed.evidence
    if evidence is not None:
        members["observation/color.jpg"] = evidence.color_jpg
        members["observation/masks.png"] = evidence.masks_png
    members["meta.json"] = meta_json(scene, written.bodies, written.certificate, members)
    return ExportedScene(
        scene.scene_id,
        tuple(sorted(members.items())),
        written.certificate,
        scene_row(scene, written.certificate),
        object_rows(scene, written.bodies, written.certificate),
        task_rows(scene),
    )
