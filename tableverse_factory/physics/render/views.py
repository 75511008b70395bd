"""The views of a scene that people and judges see: the picture's own, a raised front view, and one from the top.

Front view and top view frame the objects, not the table. `judge_sheet` puts the two side by side with a box, a number
and a label for each object, as the paper's judge is shown them (appendix B).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from schemas.geometry import Camera, Frozen, IdImage, Picture, Points, Pose
from tableverse_factory.geometry.math.transforms import rotation_matrix
from tableverse_factory.physics.mjcf.drawables import Scenery
from tableverse_factory.physics.render.preview import Sketcher
from tableverse_factory.physics.render.render import Rendering, look_at, render_views

FRONT_ELEVATION = float(np.deg2rad(38.0))
FIELD_OF_VIEW = float(np.deg2rad(34.0))
"""Vertical, of the front and top views: narrow, so that heights compare."""

SHEET_SIDE = 512
"""Of each view of a judge's sheet [px]: labels are legible, and it costs a quarter of a second."""

_MARGIN = 1.12
_NEAREST_M = 0.15
BOX_COLORS = ("#d1242f", "#0969da", "#1a7f37", "#8250df", "#bf3989", "#9a6700", "#0f766e", "#57606a")


@dataclass(frozen=True, slots=True)
class Quality:
    """How much a picture may cost.

    Attributes:
        samples: Side of the grid of samples in a pixel.
        sky_rays: Occlusion rays per pixel that darken corners.
        shadows: Whether the key light throws shadows.
    """

    samples: int = 1
    sky_rays: int = 0
    shadows: bool = True


FAST = Quality(shadows=True)
FINE = Quality(samples=2, sky_rays=6)


@dataclass(frozen=True, slots=True, eq=False)
class Eye(Frozen):
    """Where a picture is taken from.

    Attributes:
        camera: Intrinsics and size.
        camera_to_table: Pose of the camera in the table frame.
    """

    camera: Camera
    camera_to_table: Pose


def pictures(scenery: Scenery, eyes: Sequence[Eye], quality: Quality = FAST) -> tuple[Rendering, ...]:
    """The scene from each eye; what they share is prepared once."""
    return render_views(
        scenery.parts,
        [(eye.camera, eye.camera_to_table) for eye in eyes],
        paints=scenery.colors,
        shadows=quality.shadows,
        sky_rays=quality.sky_rays,
        samples=quality.samples,
    )


def photo_eye(camera: Camera, camera_to_table: Pose, width: int) -> Eye:
    """Where the picture was taken from, `width` pixels wide."""
    return Eye(resized(camera, width), camera_to_table)


def front_eye(
    scenery: Scenery, width: int, height: int, azimuth: float = 0.0, elevation: float = FRONT_ELEVATION
) -> Eye:
    """From the camera's side, raised by `elevation`; `azimuth` goes round to the right [rad]."""
    c, s = np.cos(elevation), np.sin(elevation)
    direction = np.array([c * np.sin(azimuth), -c * np.cos(azimuth), s])
    return _framing(scenery, look_at(direction, np.zeros(3)), width, height)


def top_eye(scenery: Scenery, width: int, height: int) -> Eye:
    """Straight from above, the camera's side at the bottom."""
    up = np.array([0.0, 1.0, 0.0])
    return _framing(scenery, look_at(np.array([0.0, 0.0, 1.0]), np.zeros(3), up), width, height)


def resized(camera: Camera, width: int) -> Camera:
    """The same camera with a picture `width` pixels wide."""
    share = width / camera.width
    height = max(1, round(camera.height * share))
    cx, cy = (camera.cx + 0.5) * share - 0.5, (camera.cy + 0.5) * share - 0.5
    return Camera(camera.fx * share, camera.fy * share, cx, cy, width, height)


def judge_sheet(scenery: Scenery, labels: Sequence[str], side: int = SHEET_SIDE) -> Picture:
    """Front view on the left, top view on the right, each `side` square, with boxes, numbers and labels.

    Args:
        scenery: What there is.
        labels: Of each object, in the order of `scenery.names`; untrusted text, drawn and cut to fit.
        side: Of each view [px].
    """
    sketcher = Sketcher(scenery.parts, scenery.colors)
    views = []
    for eye in (front_eye(scenery, side, side), top_eye(scenery, side, side)):
        picture, ids = sketcher.draw(eye.camera, eye.camera_to_table)
        views.append(with_boxes(picture, ids, labels))
    sheet: Picture = np.concatenate(views, axis=1)
    return sheet


@dataclass(frozen=True, slots=True, eq=False)
class _Tag(Frozen):
    text: str
    color: str
    box: tuple[int, int, int, int]


def with_boxes(picture: Picture, ids: IdImage, labels: Sequence[str]) -> Picture:
    """The picture with a 2D box around each visible part, and a tag `number: label` at its corner."""
    image = Image.fromarray(np.array(picture))
    draw = ImageDraw.Draw(image)
    font = ImageFont.load_default(size=max(12.0, picture.shape[0] / 48))
    tags = [_tag(ids, number, label) for number, label in enumerate(labels)]
    taken: list[tuple[float, float, float, float]] = []
    for tag in (tag for tag in tags if tag is not None):
        draw.rectangle(tag.box, outline=tag.color, width=2)
    for tag in (tag for tag in tags if tag is not None):
        place = _free_place(draw.textbbox((0, 0), tag.text, font=font), tag.box, image.size, taken)
        taken.append(place)
        draw.rectangle(place, fill=tag.color)
        draw.text((place[0] + 3, place[1] + 1), tag.text, fill="white", font=font)
    return np.asarray(image)


def _tag(ids: IdImage, number: int, label: str) -> _Tag | None:
    rows, columns = np.nonzero(ids == number)
    if not len(rows):
        return None
    # The built-in font has Latin letters only; others would be boxes.
    latin = label.encode("latin-1", "replace").decode("latin-1")
    text = f"{number}: {latin}" if len(latin) <= 28 else f"{number}: {latin[:25]}..."
    box = (int(columns.min()), int(rows.min()), int(columns.max()), int(rows.max()))
    return _Tag(text, BOX_COLORS[number % len(BOX_COLORS)], box)


def _free_place(
    text: tuple[float, float, float, float],
    box: tuple[int, int, int, int],
    size: tuple[int, int],
    taken: Sequence[tuple[float, float, float, float]],
) -> tuple[float, float, float, float]:
    """Above, below, within or beside the box, within the picture; the first place that covers least of other tags."""
    width, height = text[2] + 6, text[3] + 4
    left, top, right, bottom = box
    columns = [left, right - width, (left + right - width) / 2]
    rows = [top - height, bottom, top, bottom - height, top - 2 * height, bottom + height]
    corners = [(x, y) for y in rows for x in columns]
    corners += [(x, y) for y in (top, bottom - height) for x in (right, left - width)]
    places = []
    for x, y in corners:
        x, y = min(max(x, 0), max(size[0] - width, 0)), min(max(y, 0), max(size[1] - height, 0))
        places.append((x, y, x + width, y + height))
    return min(places, key=lambda place: sum(_overlap(place, other) for other in taken))


def _overlap(a: tuple[float, float, float, float], b: tuple[float, float, float, float]) -> float:
    """Area that two rectangles share [px²]."""
    return max(min(a[2], b[2]) - max(a[0], b[0]), 0.0) * max(min(a[3], b[3]) - max(a[1], b[1]), 0.0)


def _framing(scenery: Scenery, orientation: Pose, width: int, height: int) -> Eye:
    """The nearest eye of this orientation that sees every object whole, with a margin."""
    parts = scenery.parts[: len(scenery.names)] or scenery.parts
    points = np.concatenate([part.vertices for part in parts] or [np.zeros((1, 3))])
    return framing(points, orientation, width, height)


def framing(points: Points, orientation: Pose, width: int, height: int) -> Eye:
    """The nearest eye of this orientation that sees all points, with a margin.

    Args:
        points: In the table frame [m]. Shape (n, 3).
        orientation: Camera to table; its position counts for nothing.
        width: Of the picture [px].
        height: Of the picture [px].
    """
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
    return Eye(camera, Pose(rotation @ eye, orientation.quaternion_wxyz))
