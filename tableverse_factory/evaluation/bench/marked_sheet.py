"""A sheet of A4 marked on the table of a capture, as a person would mark one that lies there."""

import numpy as np
from PIL import Image, ImageDraw

from schemas.geometry import TABLE_ID, Pose
from schemas.known_length import SHEET_SIZES_M, KnownSheet, get_pixel_std
from schemas.objects import PerceivedObjects
from tableverse_factory.geometry.math.camera import project
from tableverse_factory.geometry.math.transforms import invert_pose, quaternion_about_z, transform_points
from tableverse_factory.stages.observe.depth.sheet_focal import make_sheet

STEP_M = 0.05  # between the places that are tried
HEADINGS_DEG = (0.0, 35.0, 70.0, 105.0, 140.0)
LEAST_FREE = 0.9  # share of the sheet that shows the table: nothing stands on it
MARGIN_PX = 4.0  # from the border of the picture
MIN_SIDE_PX = 20.0  # a smaller one cannot be marked


def mark_sheet(truth: PerceivedObjects, rng: np.random.Generator) -> KnownSheet | None:
    """Mark the corners of a sheet at a free place of the table, the nearest to its middle; None where there is none.

    The table and the camera are those of the sensor; the corners are off by `get_pixel_std`.
    """
    table, camera, to_camera = truth.table, truth.observation.camera, invert_pose(truth.camera_to_table)
    sheet = make_sheet(SHEET_SIZES_M["a4"])
    reach = np.arange(-float(table.half_size_xy.max()), float(table.half_size_xy.max()) + STEP_M, STEP_M)
    places = sorted(((x, y) for x in reach for y in reach), key=lambda place: (np.hypot(*place), place))
    for x, y in places:
        for heading in HEADINGS_DEG:
            turned = Pose(
                np.array([*(table.center_xy + np.array([x, y])), 0.0]), quaternion_about_z(np.radians(heading))
            )
            corners = project(transform_points(to_camera, transform_points(turned, sheet)), camera)
            if _is_free(corners, truth.instance_ids):
                marked = corners + rng.normal(0.0, get_pixel_std(truth.instance_ids.shape), (4, 2))
                return KnownSheet.model_validate({"kind": "a4", "pixels": [tuple(pixel) for pixel in marked.tolist()]})
    return None


def _is_free(corners: np.ndarray, ids: np.ndarray) -> bool:
    """Whether a sheet with these corners lies in the picture, and on nothing but the table."""
    height, width = ids.shape
    inside = (corners >= MARGIN_PX) & (corners <= np.array([width, height]) - 1 - MARGIN_PX)
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1)
    if not inside.all() or sides.min() < MIN_SIDE_PX:  # NaN, of a corner behind the camera, is not inside
        return False
    drawn = Image.new("1", (width, height))
    ImageDraw.Draw(drawn).polygon([tuple(corner) for corner in corners.tolist()], fill=1)
    return float((ids[np.asarray(drawn)] == TABLE_ID).mean()) >= LEAST_FREE
