"""An observation as points over a table: the input of every detector and segmenter."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float64

from schemas.geometry import Camera, DepthImage, Frozen, IdImage, Mask
from schemas.observation import Observation
from tableverse_factory.geometry.math.planes import Plane, Points2

FILL_ROUNDS = 2
MIN_NEIGHBOURS = 3


def compute_depth_noise(depth: Float[np.ndarray, "*shape"]) -> Float64[np.ndarray, "*shape"]:
    """Compute the standard deviation of a structured-light sensor's axial noise [m] (Nguyen, Izadi and Lovell 2012)."""
    z = np.asarray(depth, dtype=np.float64)
    return 0.0012 + 0.0019 * (z - 0.4) ** 2


def fill_depth_gaps(depth: DepthImage) -> Float64[np.ndarray, "h w"]:
    """Fill gaps of a pixel or two with a neighbouring reading, never with a mean over a step [m].

    Sensors lose readings along the edges of objects, where one object must be separated from another.
    """
    filled = np.asarray(depth, dtype=np.float64)
    for _ in range(FILL_ROUNDS):
        rows, columns = np.nonzero(filled == 0)
        padded = np.pad(filled, 1)
        steps = ((y, x) for y in range(3) for x in range(3) if (y, x) != (1, 1))
        around = np.stack([padded[rows + y, columns + x] for y, x in steps], axis=1)
        around = np.sort(np.where(around > 0, around, np.inf), axis=1)
        count = np.isfinite(around).sum(axis=1)
        enough = count >= MIN_NEIGHBOURS
        filled = filled.copy()
        filled[rows[enough], columns[enough]] = around[enough, (count[enough] - 1) // 2]
    return filled


@dataclass(frozen=True, slots=True, eq=False)
class TableView(Frozen):
    """The picture, its points, and the table below them."""

    observation: Observation
    points_camera: Float64[np.ndarray, "h w 3"]  # [m], the origin where there is no reading
    valid: Mask  # a reading or a filled gap
    plane: Plane  # in the camera frame, its normal upwards
    axes: Float64[np.ndarray, "3 3"]  # the table frame's x, y and z as camera directions, one per row
    outline_xy: Points2  # convex outline of the visible table-top, counter-clockwise, see `xy` [m]
    heights: Float64[np.ndarray, "h w"]  # above the plane [m], 0 where there is no reading
    on_plane: Mask  # the table-top itself
    raised: Mask  # clearly above the table-top or a little beside it

    @property
    def depth(self) -> Float64[np.ndarray, "h w"]:
        """Distance along the optical axis [m], small gaps filled."""
        return self.points_camera[..., 2]

    def xy(self, points_camera: Float64[np.ndarray, "*shape 3"]) -> Float64[np.ndarray, "*shape 2"]:
        """Compute coordinates along the table, their origin below the camera [m]."""
        return points_camera @ self.axes[:2].T


@dataclass(frozen=True, slots=True)
class ImageWindow:
    """A part of the picture at every `stride`-th pixel; height and width count thinned pixels."""

    top: int
    left: int
    height: int
    width: int
    stride: int

    @property
    def slices(self) -> tuple[slice, slice]:
        """Rows and columns of the picture."""
        bottom, right = self.top + self.height * self.stride, self.left + self.width * self.stride
        return slice(self.top, bottom, self.stride), slice(self.left, right, self.stride)


def find_working_window(mask: Mask, max_pixels: int, margin: int) -> ImageWindow:
    """Find a window around the mask, thinned so that the whole picture would have at most `max_pixels`."""
    stride = max(1, int(np.ceil(np.sqrt(mask.size / max_pixels))))
    rows, columns = expand_window(mask, margin * stride)
    height, width = min(rows.stop, mask.shape[0]) - rows.start, min(columns.stop, mask.shape[1]) - columns.start
    return ImageWindow(rows.start, columns.start, -(-height // stride), -(-width // stride), stride)


def expand_window(mask: Mask, margin: int) -> tuple[slice, slice]:
    """Find the rows and columns of a mask that is not empty, with a margin on either side [px]."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    first_row, first_column = max(int(rows[0]) - margin, 0), max(int(columns[0]) - margin, 0)
    return slice(first_row, int(rows[-1]) + margin + 1), slice(first_column, int(columns[-1]) + margin + 1)


def crop_view(view: TableView, window: ImageWindow) -> TableView:
    """Crop and thin the view to a window."""
    part, stride, full = window.slices, window.stride, view.observation
    cx, cy = (full.camera.cx - window.left) / stride, (full.camera.cy - window.top) / stride
    camera = Camera(full.camera.fx / stride, full.camera.fy / stride, cx, cy, window.width, window.height)
    return replace(
        view,
        observation=Observation(full.scene_id, full.color[part], full.depth[part], camera),
        points_camera=view.points_camera[part],
        valid=view.valid[part],
        heights=view.heights[part],
        on_plane=view.on_plane[part],
        raised=view.raised[part],
    )


def uncrop_ids(ids: IdImage, window: ImageWindow, shape: tuple[int, ...]) -> IdImage:
    """Scale an image of the window to the picture's size, zero around it."""
    large = np.kron(ids, np.ones((window.stride, window.stride), dtype=ids.dtype))
    full = np.zeros(shape, dtype=ids.dtype)
    target = full[window.top : window.top + large.shape[0], window.left : window.left + large.shape[1]]
    target[...] = large[: target.shape[0], : target.shape[1]]
    return full
