"""Observation of a scene: a picture, its depth and its camera."""

from dataclasses import dataclass

from schemas.detection import Detections
from schemas.geometry import Camera, DepthImage, Frozen, IdImage, Picture, TriangleMesh


@dataclass(frozen=True, slots=True, eq=False)
class Observation(Frozen):
    """Picture with metric depth, color and depth pixel-aligned.

    Attributes:
        color: Shape (h, w, 3) sRGB.
        depth: Shape (h, w) float32, distance along the optical axis [m]; 0 without a reading.
        recorded_detections: The capture's own `detections.json`, if it has one.
        recorded_ids: Shape (h, w), the capture's own `masks.png`: 0 background, else instance ids; or None.
        recorded_meshes: Instance id and mesh, of the capture's own `meshes/`; read if `place.mesh_model` is replay.
        bend: Share of the distance by which the depth may be bent smoothly over the picture, as a model's is; 0 of a
            sensor, whose noise is known.
    """

    scene_id: str
    color: Picture
    depth: DepthImage
    camera: Camera
    recorded_detections: Detections | None = None
    recorded_ids: IdImage | None = None
    recorded_meshes: tuple[tuple[int, TriangleMesh], ...] = ()
    bend: float = 0.0
