"""Standard views of a scene for people and judges: a raised front view and one from the top, framing the objects.

`draw_judge_sheet` puts the two side by side with a box, a number and a label for each object (paper appendix B).
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from schemas.geometry import Camera, IdImage, Picture, Points, Pose
from tableverse_factory.geometry.math.camera import PosedCamera, rescale_camera
from tableverse_factory.geometry.math.transforms import rotation_matrix
from tableverse_factory.physics.mjcf.scenery import Scenery
from tableverse_factory.physics.render.preview import PreviewRenderer
from tableverse_factory.physics.render.render import Rendering, look_at, render_views

Box = tuple[float, float, float, float]  # left, top, right and bottom [px]

FRONT_ELEVATION = float(np.deg2rad(38.0))
FIELD_OF_VIEW = float(np.deg2rad(34.0))  # vertical, of the front and top views: narrow, so that heights compare
SHEET_SIDE = 512  # of each view of a judge's sheet [px]: labels are legible, in a quarter of a second
_MARGIN = 1.12
_NEAREST_M = 0.15
BOX_COLORS = ("#d1242f", "#0969da", "#1a7f37", "#8250df", "#bf3989", "#9a6700", "#0f766e", "#57606a")


@dataclass(frozen=True, slots=True)
class RenderQuality:
    """Quality of a picture, see `render`."""

    samples: int = 1
    sky_rays: int = 0
    shadows: bool = True


FAST = RenderQuality(shadows=True)
FINE = RenderQuality(samples=2, sky_rays=6)


def render_pictures(
    scenery: Scenery, eyes: Sequence[PosedCamera], quality: RenderQuality = FAST
) -> tuple[Rendering, ...]:
    """Render the scene from each camera; shared data is prepared once."""
    views = [(eye.camera, eye.camera_to_table) for eye in eyes]
    return render_views(scenery.parts, views, paints=scenery.colors, **asdict(quality))


def make_front_camera(
    scenery: Scenery, width: int, height: int, azimuth: float = 0.0, elevation: float = FRONT_ELEVATION
) -> PosedCamera:
    """Make a camera on the observer's side, raised by `elevation`; `azimuth` goes round to the right [rad]."""
    c, s = np.cos(elevation), np.sin(elevation)
    direction = np.array([c * np.sin(azimuth), -c * np.cos(azimuth), s])
    return _frame_objects(scenery, look_at(direction, np.zeros(3)), width, height)


def make_top_camera(scenery: Scenery, width: int, height: int) -> PosedCamera:
    """Make a camera straight above, the observer's side at the bottom."""
    up = np.array([0.0, 1.0, 0.0])
    return _frame_objects(scenery, look_at(np.array([0.0, 0.0, 1.0]), np.zeros(3), up), width, height)


def resize_camera(camera: Camera, width: int) -> Camera:
    """Scale a camera to a picture `width` pixels wide."""
    return rescale_camera(camera, width, max(1, round(camera.height * width / camera.width)))


def draw_judge_sheet(scenery: Scenery, labels: Sequence[str], side: int = SHEET_SIDE) -> Picture:
    """Draw the front view on the left and the top view on the right, with boxes, numbers and labels.

    `labels`, in the order of `scenery.names`, are untrusted text, drawn and cut to fit; a view has `side` [px].
    """
    sketcher = PreviewRenderer(scenery.parts, scenery.colors)
    views = []
    for eye in (make_front_camera(scenery, side, side), make_top_camera(scenery, side, side)):
        picture, ids = sketcher.draw(eye.camera, eye.camera_to_table)
        views.append(draw_boxes(picture, ids, labels))
    return np.concatenate(views, axis=1)


def draw_boxes(picture: Picture, ids: IdImage, labels: Sequence[str]) -> Picture:
    """Draw a 2D box around each visible part, and a tag `number: label` at its corner."""
    image = Image.fromarray(np.array(picture))
    draw = ImageDraw.Draw(image)
    font = ImageFont.load_default(size=max(12.0, picture.shape[0] / 48))
    boxes = {number: box for number in range(len(labels)) if (box := _find_box(ids, number))}
    taken: list[Box] = []
    for number, box in boxes.items():
        draw.rectangle(box, outline=BOX_COLORS[number % len(BOX_COLORS)], width=2)
    for number, box in boxes.items():
        latin = labels[number].encode("latin-1", "replace").decode("latin-1")  # all that the built-in font has
        text = f"{number}: {latin}" if len(latin) <= 28 else f"{number}: {latin[:25]}..."
        place = _find_free_place(draw.textbbox((0, 0), text, font=font), box, image.size, taken)
        taken.append(place)
        draw.rectangle(place, fill=BOX_COLORS[number % len(BOX_COLORS)])
        draw.text((place[0] + 3, place[1] + 1), text, fill="white", font=font)
    return np.asarray(image)


def _find_box(ids: IdImage, number: int) -> Box | None:
    rows, columns = np.nonzero(ids == number)
    return (int(columns.min()), int(rows.min()), int(columns.max()), int(rows.max())) if len(rows) else None


def _find_free_place(text: Box, box: Box, size: tuple[int, int], taken: Sequence[Box]) -> Box:
    """Find the place above, below, within or beside the box, in the picture, that covers least of other tags."""
    width, height = text[2] + 6, text[3] + 4
    left, top, right, bottom = box
    columns = [left, right - width, (left + right - width) / 2]
    rows = [top - height, bottom, top, bottom - height, top - 2 * height, bottom + height]
    corners = [(x, y) for y in rows for x in columns]
    corners += [(x, y) for y in (top, bottom - height) for x in (right, left - width)]
    places: list[Box] = []
    for x, y in corners:
        x, y = min(max(x, 0), max(size[0] - width, 0)), min(max(y, 0), max(size[1] - height, 0))
        places.append((x, y, x + width, y + height))
    return min(places, key=lambda place: sum(_measure_overlap(place, other) for other in taken))


def _measure_overlap(a: Box, b: Box) -> float:
    """Area that two rectangles share [px²]."""
    return max(min(a[2], b[2]) - max(a[0], b[0]), 0.0) * max(min(a[3], b[3]) - max(a[1], b[1]), 0.0)


def _frame_objects(scenery: Scenery, orientation: Pose, width: int, height: int) -> PosedCamera:
    parts = scenery.parts[: len(scenery.names)] or scenery.parts
    points = np.concatenate([part.vertices for part in parts] or [np.zeros((1, 3))])
    return frame_points(points, orientation, width, height)


def frame_points(points: Points, orientation: Pose, width: int, height: int) -> PosedCamera:
    """Make the nearest camera of this orientation (camera to table) that sees all points [m], with a margin."""
    focal = height / (2 * np.tan(FIELD_OF_VIEW / 2))
    camera = Camera(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height)
    rotation = rotation_matrix(orientation.quaternion_wxyz)
    turned = points @ rotation
    eye, back = np.zeros(3), _NEAREST_M
    for axis, side in ((0, width), (1, height)):
        slope = side / (2 * focal) / _MARGIN
        # A point is in the picture where |p - eye| <= slope * (depth - eye depth): two half-planes per axis.
        right = float((turned[:, axis] - slope * turned[:, 2]).max())
        left = float((-turned[:, axis] - slope * turned[:, 2]).max())
        eye[axis] = (right - left) / 2
        back = max(back, (right + left) / (2 * slope))
    eye[2] = -back
    return PosedCamera(camera, Pose(rotation @ eye, orientation.quaternion_wxyz))
