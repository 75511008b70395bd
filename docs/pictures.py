"""Draws the pictures of docs/concepts.md, one for each stage, from a synthetic capture: `python docs/pictures.py`.

The capture follows from a seed, and so does what every stage makes of it: the same code draws the same pictures.
"""

import argparse
import io
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from PIL import Image, ImageDraw, ImageFont

from schemas.geometry import Picture, Points, Pose, TriangleMesh
from schemas.manifest import ImageRow
from schemas.objects import Evidence, PerceivedObjects, PlacedObjects
from schemas.observation import Observation
from schemas.outcome import Done
from schemas.scene import CuratedScene, ExportedScene, RectifiedLayout, SettledScene
from tableverse_factory.core.config import build_config
from tableverse_factory.core.seeding import make_rng
from tableverse_factory.dataset.dataset import Scene
from tableverse_factory.dataset.trajectory_files import add_digests
from tableverse_factory.delivery.episodes.actors import ArmMeshes
from tableverse_factory.delivery.episodes.film import render_frames
from tableverse_factory.evaluation.bench.ablation_picture import PALETTE, stack_panels
from tableverse_factory.geometry.math.camera import PosedCamera
from tableverse_factory.geometry.math.transforms import invert_pose, transform_points
from tableverse_factory.geometry.mesh.meshes import place_mesh
from tableverse_factory.models.services import Services
from tableverse_factory.physics.mjcf.scenery import Rgb, Scenery, load_scenery, make_scenery
from tableverse_factory.physics.mjcf.slab import Slab, fit_slab
from tableverse_factory.physics.render.views import (
    RenderQuality,
    draw_judge_sheet,
    make_front_camera,
    render_pictures,
    resize_camera,
)
from tableverse_factory.pipeline import WITH_TRAJECTORIES
from tableverse_factory.robotics.execution.arrays import Recording
from tableverse_factory.robotics.robots.registry import load_arm
from tableverse_factory.sources.manifest import make_manifest
from tableverse_factory.sources.synthetic.synthesize import synthesize_captures

SEED, NUMBER = 7, 1
"""Which synthetic capture."""
WIDTH, HEIGHT = 480, 360
QUALITY = RenderQuality(samples=2, sky_rays=6)
JPEG_QUALITY = 84
_CAPTION = 26
_AZIMUTH = float(np.deg2rad(28.0))
_LOW = float(np.deg2rad(12.0))
_TABLE_MARGIN_M = 0.25
_ARM_HEIGHT_M = 0.8
_BEYOND_M = 0.15
_SPLAT = 2
_NAMED = 5
"""Things whose masses the caption of the judge's picture has room for."""
_OVERRIDES = ("trajectories.max_tasks=6",)


def records(folder: Path, number: int) -> tuple[ImageRow, dict[str, Any]]:
    """What each stage gives of the capture, by the stage's name."""
    config = build_config({}, _OVERRIDES)
    capture = synthesize_captures(folder / "captures", number + 1, SEED)[number]
    row = make_manifest([str(capture)], config.observe).rows[0]
    item: Any = row
    found = {}
    for stage in WITH_TRAJECTORIES[row.kind]:
        outcome = stage.run(item, config, make_rng(SEED, row.scene_id, stage.name), Services(folder / "cache"))
        if not isinstance(outcome, Done):
            raise SystemExit(f"{stage.name}: {outcome}")
        found[stage.name] = item = outcome.value
    return row, found


def observed(seen: Observation) -> Picture:
    """The photograph, and its depth from near (yellow) to far (violet); black where the camera has none."""
    depth = np.asarray(seen.depth)
    near, far = np.percentile(depth[depth > 0], (1, 99))
    shade = colormaps["viridis"](np.clip((far - depth) / (far - near), 0, 1))[..., :3]
    shade[depth == 0] = 0
    return _row({"color.png": seen.color, "depth.png": (shade * 255).astype(np.uint8)})


def perceived(found: PerceivedObjects) -> Picture:
    """Each thing's pixels over the photograph, and its points on the table, seen from the side."""
    ids = np.asarray(found.instance_ids)
    veiled = np.asarray(found.observation.color).astype(float) * 0.45
    for index, its in enumerate(found.objects):
        mask = ids == its.instance_id
        veiled[mask] += 0.55 * np.array(_color(index))
    return _row({"what belongs together": veiled.astype(np.uint8), "its points, on the table": _cloud(found)})


def placed(found: PerceivedObjects, layout: PlacedObjects) -> Picture:
    """Points as seen, and the meshes that complete them."""
    meshes = _meshes(layout, [its.pose for its in layout.objects])
    eye = _eye(meshes)
    drawn = _drawn(meshes, layout, eye)
    return _row({"seen: one side of everything": _cloud(found, eye), "placed: whole meshes, in metres": drawn})


def rectified(layout: RectifiedLayout) -> Picture:
    """The meshes where the picture puts them, and their convex pieces, moved apart."""
    before = _meshes(layout.placed, [its.pose for its in layout.placed.objects])
    eye = _eye(before)
    pieces, colors = [], []
    for index, (its, pose, parts) in enumerate(zip(layout.placed.objects, layout.poses, layout.pieces, strict=True)):
        for number, hull in enumerate(parts.hulls):
            pieces.append(place_mesh(hull, pose, its.scale))
            colors.append(_shaded(_color(index), number))
    apart = render_pictures(_on_table(pieces, colors, layout.placed), (eye,), QUALITY)[0].color
    deepest = f"as placed: up to {1000 * layout.penetration_before_m:.1f} mm inside one another"
    return _row({deepest: _drawn(before, layout.placed, eye), "convex pieces, apart": apart})


def settled(scene: SettledScene) -> Picture:
    """The rectified layout from low down, and the same at rest."""
    layout = scene.rectified
    before, after = (_meshes(layout.placed, poses) for poses in (layout.poses, scene.poses))
    eye = _eye(before, _LOW)
    sunk = max(
        float(np.linalg.norm(a.vertices.mean(axis=0) - b.vertices.mean(axis=0)))
        for a, b in zip(before, after, strict=True)
    )
    panels = {
        "apart: gaps remain": _drawn(before, layout.placed, eye),
        f"at rest after {scene.settle_time_s:.1f} s, moved by {1000 * sunk:.1f} mm at most": _drawn(
            after, layout.placed, eye
        ),
    }
    return _row(panels)


def curated(scene: CuratedScene) -> Picture:
    """What the judge is shown, and what it says."""
    layout = scene.settled.rectified.placed
    names = [its.label for its in layout.objects]
    meshes = _meshes(layout, scene.settled.poses)
    scenery = make_scenery([its.object_id for its in layout.objects], meshes, _slab(layout, meshes))
    sheet = Image.fromarray(np.array(draw_judge_sheet(scenery, names))).resize(
        (2 * WIDTH, WIDTH), Image.Resampling.LANCZOS
    )
    verdict = scene.assessment
    masses = [f"{name}, {_mass(its.mass_kg)}" for name, its in zip(names, verdict.objects, strict=True)]
    tasks = sum(task.accepted for task in verdict.tasks)
    said = f"score {verdict.quality_score} of 10, {tasks} tasks; {'; '.join(masses[:_NAMED])}; and so on"
    return _captioned(np.asarray(sheet), said)


def exported(scene: ExportedScene, layout: PlacedObjects, evidence: Evidence) -> Picture:
    """The photograph, the exported scene from its camera, and what collides."""
    model = _scene(scene).model()
    eye = PosedCamera(resize_camera(evidence.camera, WIDTH), evidence.camera_to_table)
    twin, solid = (load_scenery(model, visual_group=group) for group in (2, 3))
    ids = {name: index for index, name in enumerate(dict.fromkeys(solid.names))}
    colors = [_shaded(_color(ids[name]), number) for number, name in enumerate(solid.names)]
    bare = tuple(TriangleMesh(part.vertices, part.faces) for part in solid.parts)
    pieces = Scenery(solid.names, bare, (*colors, layout.table.color))
    with_photo = {"photograph": _photograph(evidence.color_jpg)}
    drawn = {"scene.xml, same camera": twin, "what collides": pieces}
    return _row(with_photo | {name: render_pictures(its, (eye,), QUALITY)[0].color for name, its in drawn.items()})


def moved(scene: ExportedScene) -> Picture:
    """One task: at the grasp, on the way, and after the release."""
    opened = _scene(scene)
    success = next(its for its in opened.trajectories() if its.success)
    recording, figure = success.recording(), ArmMeshes(load_arm("panda"))
    phase = np.asarray(recording.phase)
    at = [int(np.flatnonzero(phase == 1)[-1]), int(np.median(np.flatnonzero(phase == 3))), len(phase) - 1]
    eye = _from_aside(recording)
    drawn = list(render_frames(opened, str(success.row["x_id"]), recording, figure, eye, at))
    captions = (str(success.row["instruction"]), "on the way", "done, and validated in simulation")
    return _row(dict(zip(captions, drawn, strict=True)))


def draw_all(folder: Path, number: int) -> Mapping[str, Picture]:
    """The picture of every stage, by its name; what is computed on the way lies in `folder`."""
    _, found = records(folder, number)
    return {
        "observe": observed(found["observe"]),
        "perceive": perceived(found["perceive"]),
        "place": placed(found["perceive"], found["place"]),
        "rectify": rectified(found["rectify"]),
        "settle": settled(found["settle"]),
        "curate": curated(found["curate"]),
        "export": exported(found["export"], found["place"], found["place"].evidence),
        "trajectories": moved(found["trajectories"]),
    }


def _scene(scene: ExportedScene) -> Scene:
    rows = add_digests(scene.trajectory_rows, scene.files)
    return Scene(scene.scene_id, scene.scene_row, dict(scene.files), lambda: rows)


def _meshes(layout: PlacedObjects, poses: Sequence[Pose]) -> list[TriangleMesh]:
    return [place_mesh(its.mesh, pose, its.scale) for its, pose in zip(layout.objects, poses, strict=True)]


def _eye(meshes: Sequence[TriangleMesh], elevation: float = float(np.deg2rad(30.0))) -> PosedCamera:
    names = tuple(str(index) for index in range(len(meshes)))
    return make_front_camera(Scenery(names, tuple(meshes), (None,) * len(meshes)), WIDTH, HEIGHT, _AZIMUTH, elevation)


def _slab(layout: PlacedObjects, meshes: Sequence[TriangleMesh]) -> Slab:
    still = Pose(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
    slab = fit_slab(layout.table, meshes, [still] * len(meshes), [1.0] * len(meshes))
    return Slab(slab.center_xy, slab.half_size_xy + _TABLE_MARGIN_M, slab.yaw, slab.color)


def _on_table(meshes: Sequence[TriangleMesh], colors: Sequence[Rgb | None], layout: PlacedObjects) -> Scenery:
    scenery = make_scenery([str(index) for index in range(len(meshes))], meshes, _slab(layout, meshes))
    return Scenery(scenery.names, scenery.parts, (*colors, layout.table.color))


def _drawn(meshes: Sequence[TriangleMesh], layout: PlacedObjects, eye: PosedCamera) -> Picture:
    return render_pictures(_on_table(meshes, [None] * len(meshes), layout), (eye,), QUALITY)[0].color


def _from_aside(recording: Recording) -> PosedCamera:
    """Across the arm's reach, so that it hides nothing of what it does."""
    base = np.asarray(recording.base.position)
    ways = np.asarray(recording.tcp, dtype=np.float64)[:, :3]
    reach = ways.mean(axis=0) - base
    azimuth = float(np.arctan2(-reach[1], -reach[0]))
    arm = base + np.outer(np.linspace(0.0, _ARM_HEIGHT_M, 5), [0.0, 0.0, 1.0])
    further = np.array([*reach[:2], 0.0]) / np.linalg.norm(reach[:2]) * _BEYOND_M
    seen = np.concatenate([ways, ways * [1.0, 1.0, 0.0] + further, arm])
    points = TriangleMesh(seen, np.zeros((0, 3), dtype=np.int32))
    return make_front_camera(Scenery(("way",), (points,), (None,)), WIDTH, HEIGHT, azimuth)


def _cloud(found: PerceivedObjects, eye: PosedCamera | None = None) -> Picture:
    """The points of all objects, the nearest in front, on white."""
    clouds = [transform_points(found.camera_to_table, its.points_camera) for its in found.objects]
    faces = np.zeros((0, 3), dtype=np.int32)
    eye = eye or _eye([TriangleMesh(points, faces) for points in clouds])
    drawn = np.full((HEIGHT, WIDTH, 3), 244, dtype=np.uint8)
    points: Points = transform_points(invert_pose(eye.camera_to_table), np.concatenate(clouds))
    colors = np.concatenate([np.tile(_color(index), (len(its), 1)) for index, its in enumerate(clouds)])
    order = np.argsort(-points[:, 2])
    x, y, z = points[order].T
    column = np.rint(eye.camera.fx * x / z + eye.camera.cx).astype(int)
    row = np.rint(eye.camera.fy * y / z + eye.camera.cy).astype(int)
    for down in range(_SPLAT):
        for right in range(_SPLAT):
            r, c = row + down, column + right
            inside = (r >= 0) & (r < HEIGHT) & (c >= 0) & (c < WIDTH)
            drawn[r[inside], c[inside]] = colors[order][inside]
    return drawn


def _color(index: int) -> Rgb:
    return PALETTE[index % len(PALETTE)]


def _shaded(color: Rgb, number: int) -> Rgb:
    """Pieces of one thing differ a little."""
    share = 1.0 - 0.12 * (number % 4)
    red, green, blue = (round(value * share) for value in color)
    return red, green, blue


def _mass(mass_kg: float) -> str:
    return f"{1000 * mass_kg:.0f} g" if mass_kg < 1 else f"{mass_kg:.1f} kg"


def _photograph(jpg: bytes) -> Picture:
    return np.asarray(Image.open(io.BytesIO(jpg)).convert("RGB"))


def _row(panels: Mapping[str, Picture]) -> Picture:
    return stack_panels([_captioned(_fitted(picture), caption) for caption, picture in panels.items()], axis=1)


def _fitted(picture: Picture) -> Picture:
    return np.asarray(Image.fromarray(np.array(picture)).resize((WIDTH, HEIGHT), Image.Resampling.LANCZOS))


def _captioned(picture: Picture, text: str) -> Picture:
    image = Image.new("RGB", (picture.shape[1], picture.shape[0] + _CAPTION), "white")
    image.paste(Image.fromarray(np.array(picture)), (0, _CAPTION))
    ImageDraw.Draw(image).text((4, 3), text, fill="black", font=ImageFont.load_default(size=15))
    return np.asarray(image)


def main() -> None:
    """Writes `stage-NAME.jpg` for every stage."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path(__file__).resolve().parent / "images")
    parser.add_argument("--scene", type=int, default=NUMBER, help="which synthetic capture")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        for stage, picture in draw_all(Path(folder), arguments.scene).items():
            file = arguments.out / f"stage-{stage}.jpg"
            Image.fromarray(np.array(picture)).save(file, "JPEG", quality=JPEG_QUALITY, optimize=True)


if __name__ == "__main__":
    main()
