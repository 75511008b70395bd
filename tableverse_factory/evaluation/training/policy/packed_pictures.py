"""Pictures of scenes before a motion, and the names of what they show: what a policy on pictures learns to see from."""

import hashlib
import io
import re
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Self

import numpy as np
from jaxtyping import Float32, Int16, Int64, UInt8

from schemas.geometry import Frozen
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.optional_imports import import_extra
from tableverse_factory.core.process_pool import count_available_cpus
from tableverse_factory.evaluation.training.packed_arrays import check_arrays, refuse_damaged, write_arrays

CAMERAS = ("front", "wrist")
SIZE = (480, 640)  # height and width of what a camera takes [px]
WINDOW = (192, 256)  # of the part that is looked at [px]
DEPTH_M = 1.25e-4  # unit of depth
OBJECTS = 24  # of a view that may be named
PHRASES, PHRASE_WORDS = 8, 14  # of an object, and of a phrase, at most
PART_WORDS = 12  # of an instruction before X, between X and Y, or after Y, at most
VOCABULARY = 1024  # numbers of words; 0 is none
_WORD = re.compile(r"[a-z0-9]+")


@dataclass(frozen=True, slots=True, eq=False)
class PackedPictures(Frozen):
    """Views (v) of scenes by the cameras (c) of an arm at home, and phrases that each name one of their objects.

    The first views are those of the demonstrations, in their order; in them X is object 1, and Y is 2. A view holds the
    `WINDOW` of each camera's picture that `find_window` chose: a JPEG file of its colours, and PNG files of its depth
    [`DEPTH_M`] and of its objects, one after the other.
    """

    files: UInt8[np.ndarray, " b"]
    ends: Int64[np.ndarray, "v c 3"]
    intrinsics: Float32[np.ndarray, "v c 4"]  # fx, fy, cx, cy of the windows [px]
    mounts: Float32[np.ndarray, "c 7"]  # poses of the cameras in the frame of the arm's base
    bases: Float32[np.ndarray, "v 7"]  # in the table frame
    held_out: UInt8[np.ndarray, " v"]
    words: Int16[np.ndarray, "v o p w"]  # numbers of the words of each phrase (p) of object o + 1
    wordings: Int16[np.ndarray, "n 3 w"]  # of instructions, in every wording and relation, around the phrases

    def write(self, path: Path) -> None:
        """Write the file, at once or not at all."""
        write_arrays(path, {field.name: getattr(self, field.name) for field in fields(self)})

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read a file that `write` wrote; raise an `InputError` if it is none."""
        with refuse_damaged(path, "a file of packed pictures", "pack them again"):
            with np.load(path, allow_pickle=False) as file:
                found = cls(**{field.name: file[field.name] for field in fields(cls)})
            found._check()
        return found

    def _check(self) -> None:
        v, c = len(self.ends), len(CAMERAS)
        wanted = {
            "files": (self.files.shape[:1], np.uint8),
            "ends": ((v, c, 3), np.int64),
            "intrinsics": ((v, c, 4), np.float32),
            "mounts": ((c, 7), np.float32),
            "bases": ((v, 7), np.float32),
            "held_out": ((v,), np.uint8),
            "words": ((v, OBJECTS, PHRASES, PHRASE_WORDS), np.int16),
            "wordings": ((len(self.wordings), 3, PART_WORDS), np.int16),
        }
        check_arrays(self, wanted)
        if not v or (np.diff(self.ends.ravel(), prepend=0) <= 0).any() or self.ends[-1, -1, -1] != len(self.files):
            raise ValueError("the ends of the pictures do not divide the file")
        numbers = np.concatenate([self.words.ravel(), self.wordings.ravel()])
        if not len(self.wordings) or numbers.min() < 0 or numbers.max() >= VOCABULARY:
            raise ValueError("there is no such word")
        if not all(np.isfinite(each).all() for each in (self.intrinsics, self.mounts, self.bases)):
            raise ValueError("cameras or bases that are not finite")

    def decode(
        self,
    ) -> tuple[UInt8[np.ndarray, "v c h w 3"], Int16[np.ndarray, "v c h w"], UInt8[np.ndarray, "v c h w"]]:
        """Decode colours, depth [`DEPTH_M`] and objects, 0 where there is none."""
        shape = (*self.ends.shape[:2], *WINDOW)
        found = np.empty((*shape, 3), np.uint8), np.empty(shape, np.int16), np.empty(shape, np.uint8)
        starts = np.concatenate([[0], self.ends.ravel()[:-1]]).reshape(self.ends.shape)

        def decode_view(view: int) -> None:
            for camera, channel in np.ndindex(*self.ends.shape[1:]):
                data = self.files[starts[view, camera, channel] : self.ends[view, camera, channel]].tobytes()
                found[channel][view, camera] = _decode(data, channel)

        with ThreadPoolExecutor(count_available_cpus()) as pool:
            for _ in pool.map(decode_view, range(len(self.ends))):
                pass
        return found


_FORMATS = (("JPEG", "RGB"), ("PNG", "I;16"), ("PNG", "L"))


def _decode(data: bytes, channel: int) -> np.ndarray:
    kind, mode = _FORMATS[channel]
    image = import_extra("PIL.Image", "training on pictures", "models")
    try:
        with image.open(io.BytesIO(data), formats=(kind,)) as opened:
            if opened.size != WINDOW[::-1] or opened.mode != mode:
                raise InputError(f"a packed picture of {opened.size} pixels, {opened.mode}, not {WINDOW[::-1]}, {mode}")
            found = np.asarray(opened)
    except OSError as error:
        raise InputError(f"a packed picture is damaged ({error}): pack them again") from error
    if found.max() > np.iinfo(np.int16).max:
        raise InputError(f"a packed depth of {found.max()} steps: the most is {np.iinfo(np.int16).max}")
    return found


def number_words(text: str, most: int) -> Int16[np.ndarray, " w"]:
    """Number the first `most` words of a text by their hash; 0 after the last."""
    words = _WORD.findall(text.lower())[:most]
    numbers = [1 + int(hashlib.sha256(word.encode()).hexdigest()[:8], 16) % (VOCABULARY - 1) for word in words]
    return np.array([*numbers, *[0] * (most - len(numbers))], dtype=np.int16)
