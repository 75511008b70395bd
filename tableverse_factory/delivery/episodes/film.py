"""Film of a trajectory, rendered from recorded states without GL and without physics."""

import io
from collections.abc import Iterator, Sequence

import numpy as np
from PIL import Image

from schemas.geometry import Picture
from tableverse_factory.dataset.dataset import Scene
from tableverse_factory.delivery.episodes.actors import ArmMeshes, build_recorded_scene, iterate_poses
from tableverse_factory.delivery.episodes.incremental_renderer import IncrementalRenderer
from tableverse_factory.geometry.math.camera import PosedCamera
from tableverse_factory.robotics.execution.arrays import Recording

_QUALITY = 82
_REST_MS = 1500
_METHOD = 4  # WebP encoder effort against size, 0 to 6


def render_frames(
    scene: Scene, x_id: str, recording: Recording, figure: ArmMeshes, eye: PosedCamera, samples: Sequence[int]
) -> Iterator[Picture]:
    """Render samples of a recording; everything that did not move stands as exported."""
    cast = build_recorded_scene(scene, x_id, figure, recording)
    pictures = IncrementalRenderer(cast.still, cast.moving, eye)
    for poses in iterate_poses(cast, figure, recording, samples):
        yield pictures.render(poses)


def choose_samples(recording: Recording, fps: float) -> list[int]:
    """Choose the samples nearest to `fps` frames per second, including the first and last."""
    last = len(recording) - 1
    count = max(int(np.ceil(last * recording.step_s * fps)), 1)
    return sorted(set(np.rint(np.linspace(0, last, count + 1)).astype(int).tolist()))


def encode_webp(pictures: Sequence[Picture], fps: float) -> bytes:
    """Encode an animated WebP that repeats after a rest at its end."""
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
