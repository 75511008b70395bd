"""Observation of a scene: a picture, its depth and its camera."""

from dataclasses import dataclass
from typing import Literal, TypeAlias

from schemas.detection import Detections
from schemas.geometry import Camera, DepthImage, Frozen, IdImage, Picture, TriangleMesh
from schemas.known_length import KnownLength

ScaleSource: TypeAlias = Literal["sensor", "estimated", "measured", "given"]
"""What metres come from: a depth sensor, a depth model, a known length, or the file of a layout."""
IntrinsicsSource: TypeAlias = Literal["capture", "exif", "sheet", "model", "assumed"]
"""What the camera comes from: its file, the picture's EXIF, the corners of a known sheet, the depth model, or the
configuration and defaults."""


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
        scale_sigma: Standard deviation of the logarithm of the scale; 0 of a sensor, and where nothing tells it.
        scale_deviation: Of a measured scale from the depth model's, in standard deviations, positive where the scene is
            larger than estimated; None where nothing was measured or the model told no `scale_sigma`.
        known_length: From which the scale is to be measured, its pixels those of `color`; None if none is known.
    """

    scene_id: str
    color: Picture
    depth: DepthImage
    camera: Camera
    recorded_detections: Detections | None = None
    recorded_ids: IdImage | None = None
    recorded_meshes: tuple[tuple[int, TriangleMesh], ...] = ()
    bend: float = 0.0
    scale_sigma: float = 0.0
    scale_source: ScaleSource = "sensor"
    intrinsics_source: IntrinsicsSource = "capture"
    known_length: KnownLength | None = None
    scale_deviation: float | None = None
