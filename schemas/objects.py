"""Objects as perceived in the picture, and as placed on the table."""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from schemas.detection import DetectionRecord
from schemas.geometry import Camera, Colors, ConvexPieces, Frozen, IdImage, Points, Pose, TriangleMesh
from schemas.observation import IntrinsicsSource, Observation, ScaleSource

SMALLEST_M, LARGEST_M = 0.001, 5.0  # sides of plausible objects


@dataclass(frozen=True, slots=True, eq=False)
class Table(Frozen):
    """Supporting plane and visible part of the table-top.

    Attributes:
        center_xy: Centre of the rectangle in the table frame [m].
        half_size_xy: Half extents along the rectangle's own axes [m].
        yaw: Rotation of the rectangle about z [rad].
        color: Mean sRGB of the table's pixels.
        rms_m: Root mean square distance of the plane's inliers [m].
    """

    center_xy: Float64[np.ndarray, "2"]
    half_size_xy: Float64[np.ndarray, "2"]
    yaw: float
    color: tuple[int, int, int]
    rms_m: float


@dataclass(frozen=True, slots=True, eq=False)
class PerceivedObject(Frozen):
    """Object in the picture.

    Attributes:
        instance_id: The value of its pixels in `PerceivedObjects.instance_ids`, > 0.
        label: Untrusted, cleaned text; `object` where the detector cannot name it.
        score: Confidence of the detection, 0 to 1.
        points_camera: Denoised surface points, camera frame [m]. Shape (n, 3); `colors` are their sRGB.
        contained_in: Id of the container that holds it, or None.
        count: Number of such objects (contents of a composite; one representative is segmented).
    """

    object_id: str
    instance_id: int
    label: str
    score: float
    points_camera: Points
    colors: Colors
    contained_in: str | None = None
    count: int = 1


@dataclass(frozen=True, slots=True)
class Explanation:
    """What stands above the table in a picture, and how much of it each object explains.

    Attributes:
        points: Number of pixels.
        area_m2: Their area across the line of sight [m²].
        of_objects: Id of each object with its pixels and area among them.
    """

    points: int
    area_m2: float
    of_objects: tuple[tuple[str, int, float], ...]

    def measure_shares(self, object_ids: Collection[str]) -> tuple[float, float]:
        """Measure the shares of points and area that these objects explain; 1 where nothing stands above the table."""
        own = [(points, area) for name, points, area in self.of_objects if name in object_ids]
        points, area = (sum(values) for values in zip((0, 0.0), *own, strict=True))
        return points / self.points if self.points else 1.0, min(area / self.area_m2, 1.0) if self.points else 1.0

    def describe_shortfall(self, object_ids: Collection[str], least: float) -> str:
        """Describe how much area these objects leave unexplained; empty if they explain at least this share."""
        points, area = self.measure_shares(object_ids)
        if area >= least:
            return ""
        return (
            f"objects found: {len(object_ids)}; they explain {area:.0%} of the {1e4 * self.area_m2:.0f} cm² and "
            f"{points:.0%} of the {self.points} pixels above the table; at least {least:.0%} of the area is wanted"
        )


@dataclass(frozen=True, slots=True, eq=False)
class PerceivedObjects(Frozen):
    """Objects found in one observation.

    Attributes:
        camera_to_table: Pose of the camera in the table frame.
        instance_ids: Shape (h, w): 0 background, -1 table, else `PerceivedObject.instance_id`.
        perception: Name of the backend that found them, e.g. `geometric`, `replay`.
        left_out: Ids of objects that were found but cannot be used, with the reason.
        detection: Origin of the answer of a model that found them; None if none was asked.
        explanation: What stands above the table, and which objects explain it; None where it was not measured.
    """

    scene_id: str
    observation: Observation
    camera_to_table: Pose
    table: Table
    instance_ids: IdImage
    objects: tuple[PerceivedObject, ...]
    perception: str
    left_out: tuple[tuple[str, str], ...] = ()
    detection: DetectionRecord | None = None
    explanation: Explanation | None = None


@dataclass(frozen=True, slots=True)
class FitUncertainty:
    """Uncertainty of the pose of a mesh in a picture.

    Attributes:
        position_std_m: Standard deviation of the middle of its box: of the length of the error, all axes together [m].
        heading_std_rad: The same of the turn about the vertical [rad]; None for a round mesh, which has no heading.
        heading_folds: How many headings look alike: 1 none but its own, 2 as with a box, 0 all of them.
        ambiguity: Misfit over that of the best other placement that was tried, 0 to 1; near 1 either could be true.
            0 where no other was in question.
    """

    position_std_m: float
    heading_std_rad: float | None
    heading_folds: int
    ambiguity: float


@dataclass(frozen=True, slots=True, eq=False)
class PlacedObject(Frozen):
    """Mesh in the table frame: `vertex_table = R(q) @ (scale * vertex) + position`.

    Attributes:
        mesh: In its own frame, before `scale`.
        pose: Its own frame in the table frame.
        fit_residual_m: Median distance from the observed points to the placed mesh [m]; 0 for a layout.
        completion: Which MeshModel made the mesh: `carved`, `replay`, `layout`, …
        count: Number of such objects; 1 once the composite is assembled, when each is an object of its own.
        copy_of: The object whose mesh, label and pose this one repeats, where it was counted but not seen by itself.
        uncertainty: Of the pose as the picture gave it; None for a layout.
        mesh_licence: Licence of the model that made the mesh; None if none did.
        pieces: Convex pieces of the mesh, where they are known already, as those of a cousin from its parent.
    """

    object_id: str
    label: str
    label_confidence: float
    mesh: TriangleMesh
    scale: float
    pose: Pose
    contained_in: str | None = None
    count: int = 1
    fit_residual_m: float = 0.0
    completion: str = "layout"
    copy_of: str | None = None
    uncertainty: FitUncertainty | None = None
    mesh_licence: str | None = None
    pieces: ConvexPieces | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Evidence(Frozen):
    """Parts of the picture that the dataset keeps.

    Attributes:
        color_jpg: The picture as a JPEG file.
        masks_png: Instance ids as found in the picture, less what smeared depth added to the objects that were placed:
            a 16-bit PNG file (0 background).
        object_pixels: Value in `masks_png` of each object, in the order of the objects.
        camera_to_table: Pose of the camera in the table frame.
        scale_source: What metres come from, with `scale_sigma`, `scale_deviation` and `intrinsics_source` as in
            `Observation`.
    """

    color_jpg: bytes
    masks_png: bytes
    object_pixels: tuple[int, ...]
    camera: Camera
    camera_to_table: Pose
    scale_source: ScaleSource = "sensor"
    scale_sigma: float = 0.0
    intrinsics_source: IntrinsicsSource = "capture"
    scale_deviation: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class PlacedObjects(Frozen):
    """Layout before rectification: from a picture, or read from a layout file.

    Attributes:
        evidence: The picture it came from; None for a layout file.
        left_out: Ids of objects that were found but could not be used or placed, with the reason.
        explanation: As in `PerceivedObjects`.
        changes: What a cousin changes of its parent, e.g. `turn:obj_003=+85`.
    """

    scene_id: str
    table: Table
    objects: tuple[PlacedObject, ...]
    evidence: Evidence | None = None
    perception: str = "layout"
    left_out: tuple[tuple[str, str], ...] = ()
    detection: DetectionRecord | None = None
    explanation: Explanation | None = None
    changes: tuple[str, ...] = ()
