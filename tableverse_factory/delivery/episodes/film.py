"""The film of a trajectory: the recorded states seen by a camera, without GL and without physics."""

import io
from collections.abc import Iterator, Sequence

import numpy as np
from PIL import Image

from schemas.geometry import Picture
from tableverse_factory.dataset.dataset import Scene
from tableverse_factory.delivery.episodes.actors import ArmFigure, cast_of, poses_over_time
from tableverse_factory.delivery.episodes.incremental_renderer import MovingPictures
from tableverse_factory.physics.render.views import Eye
from tableverse_factory.robotics.execution.arrays import Recording

_QUALITY = 82
_REST_MS = 1500
_METHOD = 4
"""Of the WebP encoder, 0 to 6: effort against size."""


def frames(
    scene: Scene, x_id: str, recording: Recording, figure: ArmFigure, eye: Eye, samples: Sequence[int]
) -> Iterator[Picture]:
    """A picture for each of the samples of a recording.

    Args:
        scene: Everything but what moves stands as it was exported.
        x_id: The object that is carried.
        recording: Of the trajectory.
        figure: The arm that it was recorded with.
        eye: The camera.
        samples: Indices into the recording.

    Raises:
        InputError: if the scene does not load, has no such object, or the recording is of another arm.
    """
    cast = cast_of(scene, x_id, figure, recording)
    pictures = MovingPictures(cast.still, cast.moving, eye)
    for poses in poses_over_time(cast, figure, recording, samples):
        yield pictures.frame(poses)


def samples_at(recording: Recording, fps: float) -> list[int]:
    """The samples nearest to `fps` pictures per second, the first and the last among them."""
    last = len(recording) - 1
    count = max(int(np.ceil(last * recording.step_s * fps)), 1)
    return sorted(set(np.rint(np.linspace(0, last, count + 1)).astype(int).tolist()))


def webp_bytes(pictures: Sequence[Picture], fps: float) -> bytes:
    """An animated WebP that repeats after a rest at its end; every browser shows it without a player."""
    images = [Image.fromarray(np.ascontiguousarray(picture)) for picture in pictures]
    file = io.BytesIO()
    images[0].save(
        file,
        "WEBP",
        save_all=True,
        append_images=images[1:],
        duration=[*[round(1000 / fps)] * (len(images) - 1), _REST_MS],
        loop=0,
        quality=_QUALITY,
        method=_METHOD,
        minimize_size=True,
    )
    return file.getvalue()
