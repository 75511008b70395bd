"""Demonstrations that policies learn from: one compact file of plain arrays, read with numpy alone."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Self

import numpy as np
from jaxtyping import Float32, Int16, Int32, UInt8

from schemas.geometry import Frozen
from tableverse_factory.evaluation.training.packed_arrays import check_arrays, refuse_damaged, write_arrays

POINTS = 192  # on the surface of each object
POINT_M = 1e-4  # unit of their coordinates
POSITION_M = 5e-5  # unit of positions of the gripper and the carried object
OPENING_M = 1e-5  # unit of openings
QUATERNION = 1.0 / 32767  # unit of quaternions
ROWS = 12  # objects of a demonstration at most: X, Y, and the others nearest to X
STEP_S = 0.04  # between samples
RELATIONS = (
    "on",
    "in",
    "into",
    "inside",
    "next to",
    "outside",
    "to the left of",
    "to the right of",
    "in front of",
    "behind",
)  # in the order of their numbers here
LAST_SHARE = 1 << 8
_ALONG_TIME = ("tcp", "carried", "opening")


@dataclass(frozen=True, slots=True, eq=False)
class Demonstrations(Frozen):
    """Objects (o), demonstrations (n) and their samples (t), `STEP_S` apart; poses are position and quaternion wxyz."""

    points: Int16[np.ndarray, "o p 3"]  # of each object's surface in its own frame [`POINT_M`]
    poses: Float32[np.ndarray, "o 7"]  # of each object before the motion, in the table frame
    objects: Int32[np.ndarray, "n r"]  # of X, of Y, of the others; -1 where there are no more
    scenes: Int32[np.ndarray, " n"]  # number of the scene
    relations: UInt8[np.ndarray, " n"]  # index into `RELATIONS`
    held_out: UInt8[np.ndarray, " n"]  # 1 for validation
    bases: Float32[np.ndarray, "n 7"]  # pose of the arm's base
    ends: Int32[np.ndarray, " n"]  # samples up to the end of each demonstration
    tcp: Int16[np.ndarray, "t 7"]  # commanded pose of the gripper, in the table frame [`POSITION_M`, `QUATERNION`]
    carried: Int16[np.ndarray, "t 7"]  # pose of X, likewise
    opening: Int16[np.ndarray, "t 2"]  # commanded and measured [`OPENING_M`]
    phases: UInt8[np.ndarray, " t"]  # index into `Phase`

    def __len__(self) -> int:
        return len(self.ends)

    def write(self, path: Path) -> None:
        """Write the file, at once or not at all; equal demonstrations give equal bytes."""
        arrays = {field.name: getattr(self, field.name) for field in fields(self)}
        for name in _ALONG_TIME:  # differences compress to half
            arrays[name] = np.diff(arrays[name].view(np.uint16), axis=0, prepend=np.uint16(0))
        write_arrays(path, arrays)

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read a file that `write` wrote; raise an `InputError` if it is none."""
        with refuse_damaged(path, "a file of packed demonstrations", "pack them again"):
            with np.load(path, allow_pickle=False) as file:
                arrays = {field.name: file[field.name] for field in fields(cls)}
            for name in _ALONG_TIME:
                arrays[name] = np.cumsum(arrays[name], axis=0, dtype=np.uint16).view(np.int16)
            found = cls(**arrays)
            found._check()
        return found

    def _check(self) -> None:
        """Check shapes, types and indices of a file of any origin."""
        o, n, t = len(self.points), len(self.ends), len(self.phases)
        wanted = {
            "points": ((o, POINTS, 3), np.int16),
            "poses": ((o, 7), np.float32),
            "objects": ((n, ROWS), np.int32),
            "scenes": ((n,), np.int32),
            "relations": ((n,), np.uint8),
            "held_out": ((n,), np.uint8),
            "bases": ((n, 7), np.float32),
            "ends": ((n,), np.int32),
            "tcp": ((t, 7), np.int16),
            "carried": ((t, 7), np.int16),
            "opening": ((t, 2), np.int16),
            "phases": ((t,), np.uint8),
        }
        check_arrays(self, wanted)
        if not n or (np.diff(self.ends, prepend=0) < 1).any() or self.ends[-1] != t:
            raise ValueError("the ends of the demonstrations do not divide the samples")
        if self.objects.max() >= o or (self.objects[:, :2] < 0).any() or self.objects.min() < -1:
            raise ValueError("demonstrations of objects that are not there")
        if self.relations.max() >= len(RELATIONS) or self.phases.max() > 5:
            raise ValueError("there is no such relation or phase")
        if not (np.isfinite(self.poses).all() and np.isfinite(self.bases).all()):
            raise ValueError("poses that are not finite")
