"""Training views: depth images of synthetic scenes with their object ids, several per scene, on the disk."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Self
from zipfile import BadZipFile

import numpy as np
from jaxtyping import Float64, UInt8, UInt16

from schemas.geometry import Camera, Frozen, Pose, TriangleMesh
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.process_pool import parallel_map
from tableverse_factory.core.seeding import make_rng
from tableverse_factory.evaluation.training.packed_arrays import write_arrays
from tableverse_factory.geometry.math.transforms import matrix_from_pose
from tableverse_factory.geometry.mesh.meshes import place_mesh
from tableverse_factory.physics.render.raycast import Raycaster, compute_camera_rays
from tableverse_factory.sources.synthetic import studio
from tableverse_factory.sources.synthetic.recipes import PlacedModel
from tableverse_factory.sources.synthetic.scene import arrange_scene
from tableverse_factory.sources.synthetic.sensor import make_sensor, sense_depth
from tableverse_factory.sources.synthetic.settle import TABLE_THICKNESS_M
from tableverse_factory.sources.synthetic.solids import make_block

VIEWS_PER_SCENE = 6
COARSER = 2  # pixels of the synthetic camera per pixel of a view
FOCAL_RANGE = (0.85, 1.2)
MAX_SCENES = 1_000_000
SCENES_AT_A_TIME = 4
WALL_SHARE = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class TrainingView(Frozen):
    """A depth image with its truth."""

    depth: UInt16[np.ndarray, "h w"]  # in units of `depth_scale`; 0 without a reading
    ids: UInt8[np.ndarray, "h w"]  # object id at each pixel from 1; 0 elsewhere
    focal: Float64[np.ndarray, "4"]  # fx, fy, cx, cy [px]
    camera_to_table: Float64[np.ndarray, "4 4"]  # pose of the camera as a 4 × 4 matrix [m]
    depth_scale: float  # metres per unit of depth

    @property
    def camera(self) -> Camera:
        """Intrinsics of the image."""
        fx, fy, cx, cy = (float(v) for v in self.focal)
        return Camera(fx, fy, cx, cy, self.depth.shape[1], self.depth.shape[0])

    def write(self, path: Path) -> None:
        """Write the view atomically."""
        write_arrays(path, {field.name: getattr(self, field.name) for field in fields(self)})

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read a view that `write` wrote; raise an `InputError` if the file is not a view."""
        try:
            with np.load(path, allow_pickle=False) as file:
                scale = float(file["depth_scale"])
                return cls(file["depth"], file["ids"], file["focal"], file["camera_to_table"], scale)
        except (OSError, ValueError, KeyError, EOFError, BadZipFile) as error:
            raise InputError(
                f"{path} is not a training view ({type(error).__name__}): remove it, and it is made again"
            ) from error


def make_views(
    folder: Path, scenes: int, seed: int, on_scene: Callable[[], object] = lambda: None, jobs: int = 1
) -> list[Path]:
    """Make the views of scenes and return their files; existing ones are kept. A scene depends on the seed."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    make = partial(_make_scene_files, folder, seed)
    for own in parallel_map(make, range(scenes), jobs, "makes views", SCENES_AT_A_TIME):
        paths += own
        on_scene()
    return paths


def _make_scene_files(folder: Path, seed: int, index: int) -> list[Path]:
    name = f"train_{seed}_{index:06d}"
    own = [folder / f"{name}_{k}.npz" for k in range(VIEWS_PER_SCENE)]
    if not all(path.is_file() for path in own):
        for path, view in zip(own, render_scene_views(seed, name), strict=True):
            view.write(path)
    return own


def render_scene_views(seed: int, scene_id: str) -> list[TrainingView]:
    """Render a settled scene from several random directions, each with its own camera and sensor."""
    rng = make_rng(seed, scene_id, "train")
    placed, half_xy = arrange_scene(rng, scene_id)
    objects = [place_mesh(item.model.mesh, item.pose) for item in placed]
    views = []
    for _ in range(VIEWS_PER_SCENE):
        azimuth = float(rng.uniform(0.0, 2 * np.pi))
        caster = Raycaster([*objects, *_make_surroundings(rng, half_xy, azimuth)])
        views.append(_render_view(rng, caster, placed, objects, azimuth))
    return views


def _render_view(
    rng: np.random.Generator,
    caster: Raycaster,
    placed: Sequence[PlacedModel],
    objects: Sequence[TriangleMesh],
    azimuth: float,
) -> TrainingView:
    full = studio.make_camera(rng)
    zoom = float(rng.uniform(*FOCAL_RANGE))
    full = replace(full, fx=full.fx * zoom, fy=full.fy * zoom)
    pose = studio.choose_viewpoint(rng, full, azimuth, np.concatenate([mesh.vertices for mesh in objects]))
    focal = np.array([full.fx, full.fy, full.cx, full.cy]) / COARSER
    fx, fy, cx, cy = (float(v) for v in focal)
    camera = Camera(fx, fy, cx, cy, full.width // COARSER, full.height // COARSER)
    depth, facing, shiny, ids = _cast_view(caster, camera, pose, np.array([item.model.shiny for item in placed]))
    sensor = make_sensor(rng)
    in_pixels = ("disparity_sigma", "disparity_step", "wobble")
    sensor = replace(sensor, **{name: getattr(sensor, name) / COARSER for name in in_pixels})
    sensed = sense_depth(rng, sensor, camera, depth, facing, shiny)
    return TrainingView(sensed, ids, focal, matrix_from_pose(pose), sensor.depth_scale)


def _cast_view(
    caster: Raycaster, camera: Camera, pose: Pose, shininess: Float64[np.ndarray, " n"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, UInt8[np.ndarray, "h w"]]:
    """Cast true depth [m], cosine between normal and line of sight, shininess and ids per pixel."""
    hits = caster.cast(camera, pose)
    depth, facing, shiny = (np.zeros(camera.height * camera.width, dtype=np.float64) for _ in range(3))
    ids = np.zeros(camera.height * camera.width, dtype=np.uint8)
    rays = compute_camera_rays(camera, pose, (0.0, 0.0))[hits.pixels]
    depth[hits.pixels] = hits.depth
    facing[hits.pixels] = np.abs(np.einsum("ij,ij->i", rays, hits.normals)) / np.linalg.norm(rays, axis=1)
    is_object = hits.part < len(shininess)
    ids[hits.pixels] = np.where(is_object, hits.part + 1, 0)
    shiny[hits.pixels] = np.append(shininess, 0.0)[np.where(is_object, hits.part, len(shininess))]
    shape = (camera.height, camera.width)
    return depth.reshape(shape), facing.reshape(shape), shiny.reshape(shape), ids.reshape(shape)


def _make_surroundings(rng: np.random.Generator, half_xy: tuple[float, float], azimuth: float) -> list[TriangleMesh]:
    """Make table, floor, and often a wall behind the table."""
    top = make_block((2 * half_xy[0], 2 * half_xy[1], TABLE_THICKNESS_M)).translate((0.0, 0.0, -TABLE_THICKNESS_M))
    floor = make_block((6.0, 6.0, 0.02)).translate((0.0, 0.0, studio.FLOOR_M - 0.02))
    meshes = [top.to_mesh(), floor.to_mesh()]
    if rng.random() < WALL_SHARE:
        wall = make_block((0.02, 6.0, 2.6)).translate((rng.uniform(1.0, 2.2), 0.0, studio.FLOOR_M))
        meshes.append(wall.rotate((0.0, 0.0, float(np.degrees(azimuth)))).to_mesh())
    return meshes
