"""H.264 in MP4 by PyAV: encoded per episode, then concatenated without encoding again."""

import io
from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from schemas.geometry import Picture
from tableverse_factory.core.optional_imports import import_extra

CODEC, PIXELS = "libx264", "yuv420p"
_OPTIONS = {
    "crf": "20",
    "preset": "medium",
    "g": "2",  # a frame is found without decoding a hundred others
    "bf": "0",  # frames in the order in which they are shown: episodes can be put one after the other
    "threads": "1",  # more would make the bytes depend on the machine
}
_TICKS = 1000  # clock ticks per frame


def import_av() -> ModuleType:
    """Import PyAV; InputError `no_extra` if it is not installed."""
    return import_extra("av", "a video", "episodes")


def encode_mp4(pictures: Iterable[Picture], fps: int) -> bytes:
    """Encode pictures with even sides as a video; equal pictures give equal bytes."""
    av, file = import_av(), io.BytesIO()
    with av.open(file, "w", format="mp4") as container:
        stream = None
        for number, picture in enumerate(pictures):
            if stream is None:
                stream = container.add_stream(CODEC, fps, options=_OPTIONS)
                stream.height, stream.width, stream.pix_fmt = *picture.shape[:2], PIXELS
                stream.thread_count = 1
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
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
                self._stream = self._container.add_stream_from_template(stream)
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
