"""Videos in MP4 by PyAV: encoded per episode, then concatenated without encoding again."""

import io
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from tableverse_factory.core.optional_imports import import_extra
from tableverse_factory.delivery.episodes.pictures import DEPTH, INSTANCES, MAX_DEPTH_M

_OPTIONS = {
    "preset": "medium",
    "g": "2",  # a frame is found without decoding a hundred others
    "bf": "0",  # frames in the order in which they are shown: episodes can be put one after the other
    "threads": "1",  # more would make the bytes depend on the machine
}
_DEPTH_STEP_M = 0.001


@dataclass(frozen=True, slots=True)
class VideoKind:
    """Encoding of a kind of pictures; `info` is what LeRobot is told beyond size, codec and pixels."""

    encoder: str
    codec: str  # as players call it
    source: str  # layout of the arrays
    pixels: str  # in the file
    options: Mapping[str, str]
    channels: int = 3
    info: Mapping[str, Any] = field(default_factory=lambda: {"video.is_depth_map": False})

    def encode(self, picture: np.ndarray) -> np.ndarray:
        """Convert a picture of shape (h, w, c) to the layout of `source`."""
        if self.source == "gray12le":
            return np.rint(picture[..., 0] / _DEPTH_STEP_M).astype(np.uint16)
        return np.ascontiguousarray(np.broadcast_to(picture, (*picture.shape[:2], self.channels)))


COLOR = VideoKind("libx264", "h264", "rgb24", "yuv420p", {**_OPTIONS, "crf": "20"})
LABELS = VideoKind("libx264rgb", "h264", "rgb24", "rgb24", {**_OPTIONS, "qp": "0"})  # exact, in every channel
METERS = VideoKind(  # exact to half a millimetre
    "libx265",
    "hevc",
    "gray12le",
    "gray12le",
    {"x265-params": "lossless=1:keyint=2:bframes=0:pools=none:frame-threads=1:log-level=error"},
    1,
    {
        "video.is_depth_map": True,
        "depth_unit": "m",
        "video.depth_min": 0.0,
        "video.depth_max": MAX_DEPTH_M,
        "video.shift": 0.0,
        "video.use_log": False,
    },
)
_TICKS = 1000  # clock ticks per frame


def import_av() -> ModuleType:
    """Import PyAV; InputError `no_extra` if it is not installed."""
    return import_extra("av", "a video", "episodes")


def find_kind(name: str) -> VideoKind:
    """Find the encoding of pictures by their name (`pictures.PICTURES`)."""
    return METERS if name.endswith(DEPTH) else LABELS if name.endswith(INSTANCES) else COLOR


def encode_mp4(pictures: Iterable[np.ndarray], fps: int, kind: VideoKind) -> bytes:
    """Encode pictures with even sides as a video; equal pictures give equal bytes."""
    av, file = import_av(), io.BytesIO()
    with av.open(file, "w", format="mp4") as container:
        stream = None
        for number, picture in enumerate(pictures):
            if stream is None:
                stream = container.add_stream(kind.encoder, fps, options=dict(kind.options))
                stream.height, stream.width, stream.pix_fmt = *picture.shape[:2], kind.pixels
                stream.thread_count = 1
            frame = av.VideoFrame.from_ndarray(kind.encode(picture), format=kind.source)
            frame.pts, frame.time_base = number, Fraction(1, fps)
            container.mux(stream.encode(frame))
        if stream is not None:
            container.mux(stream.encode())
    return file.getvalue()


class VideoFile:
    """MP4 of many episodes; dataset-wide frame k is shown from k / fps on."""

    def __init__(self, path: Path, fps: int) -> None:
        self._av, self._fps = import_av(), fps
        self._container = self._av.open(str(path), "w", format="mp4")
        self._stream: Any = None
        self.n_frames, self.n_bytes = 0, 0

    def add(self, video: bytes) -> None:
        """Append a video of `encode_mp4`, packet by packet."""
        with self._av.open(io.BytesIO(video)) as source:
            stream = source.streams.video[0]
            if self._stream is None:
                self._stream = self._container.add_stream_from_template(stream, opaque=True)
                self._stream.time_base = Fraction(1, self._fps * _TICKS)
            count = 0
            for packet in source.demux(stream):
                if packet.size == 0:
                    continue
                packet.time_base = Fraction(1, self._fps * _TICKS)
                packet.pts = packet.dts = (self.n_frames + count) * _TICKS
                packet.duration = _TICKS
                packet.stream = self._stream
                self._container.mux(packet)
                count += 1
        self.n_frames += count
        self.n_bytes += len(video)

    def close(self) -> None:
        """Write the index, which completes the video."""
        self._container.close()
