"""First pictures of demonstrations and their instructions in words: what goals are drawn from by sight."""

import hashlib
import io
import re
import zlib
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Self
from zipfile import BadZipFile

import numpy as np
from jaxtyping import Int16, Int64, UInt8

from schemas.geometry import Frozen
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.optional_imports import import_extra
from tableverse_factory.evaluation.training.packed_arrays import write_arrays

CAMERAS = ("front", "wrist")
SIZE = (96, 128)  # height and width [px]
WORDS = 24  # of an instruction at most
VOCABULARY = 1024  # numbers of words; 0 is none
WORDINGS = 4  # the instruction and three paraphrases
QUALITY = 92
_WORD = re.compile(r"[a-z0-9]+")


@dataclass(frozen=True, slots=True, eq=False)
class FirstPictures(Frozen):
    """Pictures as JPEG files, one after the other: of each of n demonstrations in the order of `CAMERAS`."""

    files: UInt8[np.ndarray, " b"]
    ends: Int64[np.ndarray, "n c"]
    words: Int16[np.ndarray, "n w k"]  # numbers of the words of each wording

    def write(self, path: Path) -> None:
        """Write the file, at once or not at all."""
        write_arrays(path, {field.name: getattr(self, field.name) for field in fields(self)})

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read a file that `write` wrote; raise an `InputError` if it is none."""
        try:
            with np.load(path, allow_pickle=False) as file:
                found = cls(**{field.name: file[field.name] for field in fields(cls)})
            found._check()
        except (OSError, ValueError, KeyError, EOFError, TypeError, BadZipFile, zlib.error) as error:
            raise InputError(f"{path}: no packed pictures ({error}): pack them again") from error
        return found

    def _check(self) -> None:
        n = len(self.ends)
        if self.files.dtype != np.uint8 or self.ends.dtype != np.int64 or self.words.dtype != np.int16:
            raise ValueError("arrays of other types")
        if self.ends.shape != (n, len(CAMERAS)) or self.words.shape != (n, WORDINGS, WORDS):
            raise ValueError(f"shapes {self.ends.shape} and {self.words.shape}")
        if n and ((np.diff(self.ends.ravel(), prepend=0) <= 0).any() or self.ends[-1, -1] != len(self.files)):
            raise ValueError("the ends of the pictures do not divide the file")
        if n and (self.words.min() < 0 or self.words.max() >= VOCABULARY):
            raise ValueError("there is no such word")

    def decode(self) -> UInt8[np.ndarray, "n c h w 3"]:
        """Decode all pictures."""
        image = import_extra("PIL.Image", "training on pictures", "models")
        starts, decoded = [0, *self.ends.ravel()[:-1].tolist()], []
        for start, end in zip(starts, self.ends.ravel().tolist(), strict=True):
            with image.open(io.BytesIO(self.files[start:end].tobytes()), formats=("JPEG",)) as opened:
                if opened.size != SIZE[::-1]:
                    raise InputError(f"a packed picture of {opened.size} pixels, not {SIZE[::-1]}")
                decoded.append(np.asarray(opened.convert("RGB")))
        return np.array(decoded, dtype=np.uint8).reshape(*self.ends.shape, *SIZE, 3)


def number_words(instruction: str) -> Int16[np.ndarray, " k"]:
    """Number the words of an instruction by their hash; 0 after the last."""
    words = _WORD.findall(instruction.lower())[:WORDS]
    numbers = [1 + int(hashlib.sha256(word.encode()).hexdigest()[:8], 16) % (VOCABULARY - 1) for word in words]
    return np.array([*numbers, *[0] * (WORDS - len(numbers))], dtype=np.int16)
