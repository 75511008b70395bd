"""Recordings as `trajectories/<task_id>.npz`: robot commands and the resulting states, as plain numpy arrays.

A zip of `.npy` files that `numpy.load` reads: stored without compression, with fixed dates and in a fixed order, so
that equal recordings give equal bytes. Files of any origin are bounded and checked before use.
"""

import io
import math
import re
import zipfile
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, Int32, UInt8

from schemas.geometry import Frozen, Pose
from schemas.identity import check_id
from schemas.trajectories import Phase
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.text import sanitize_line

FORMAT = "tableverse-trajectory-1"
MAX_BYTES = 64 * 1024 * 1024
MAX_DURATION_S = 120.0
# As the configuration bounds `trajectories.step_s`: replaying any file takes bounded time
MIN_STEP_S, MAX_STEP_S = 0.004, 0.1
MAX_SAMPLES = round(MAX_DURATION_S / MIN_STEP_S) + 1
MAX_MOVED = 1000
MAX_JOINTS = 64
MAX_NAME_BYTES = 4096
_MAX_NUMBER = 1e6  # bound of every length, angle, speed and time, checked before physics
_MAX_HEADER_BYTES = 1024
_HEADER = re.compile(  # as numpy writes it; numpy's own reader evaluates a header as Python
    rb"\x93NUMPY\x01\x00..\{'descr': '([<|][a-zA-Z]\d)', 'fortran_order': (True|False), "
    rb"'shape': \(((?:\d{1,7},? ?){0,3})\), \} *\n",
    re.DOTALL,
)
_QUATERNION_TOLERANCE, _TIME_TOLERANCE = 1e-3, 1e-3
_DATE = (1980, 1, 1, 0, 0, 0)
_ARRAYS = {  # type and number of dimensions of every array, in the order of the file
    "format": ("|u1", 1),
    "robot": ("|u1", 1),
    "base": ("<f8", 1),
    "step_s": ("<f8", 0),
    "max_disturbed_m": ("<f8", 0),
    "command": ("<f8", 2),
    "phase": ("<i4", 1),
    "time_s": ("<f4", 1),
    "qpos": ("<f4", 2),
    "qvel": ("<f4", 2),
    "tcp": ("<f4", 2),
    "object_pose": ("<f4", 2),
    "pads": ("|u1", 1),
    "disturbed_m": ("<f4", 1),
    "moved_ids": ("|u1", 1),
    "moved_poses": ("<f4", 3),
}
_DECODED = frozenset({"format", "robot", "base", "step_s", "max_disturbed_m", "moved_ids"})


@dataclass(frozen=True, slots=True, eq=False)
class Recording(Frozen):
    """Executed motion, sampled when the arm's targets have just reached each command.

    A failed motion ends soon after the sample that decided. Objects that are not in `moved_ids` stand as exported.
    """

    robot: str  # name or file of the arm, as in the configuration
    base: Pose  # of the robot in the table frame; exact
    step_s: float
    max_disturbed_m: float  # allowed displacement of other objects
    command: Float64[np.ndarray, "t k"]  # targets of the joints [rad] and opening of the gripper [m], exact
    phase: Int32[np.ndarray, " t"]  # index into `Phase`, ascending; the last one includes the wait for rest
    time_s: Float32[np.ndarray, " t"]  # since the start
    qpos: Float32[np.ndarray, "t m"]  # joints [rad] and fingers [m]
    qvel: Float32[np.ndarray, "t m"]  # their speeds
    tcp: Float32[np.ndarray, "t 7"]  # gripper frame in the table frame: position [m], quaternion wxyz
    object_pose: Float32[np.ndarray, "t 7"]  # the carried object's own frame, likewise
    pads: UInt8[np.ndarray, " t"]  # fingers that touch the object: 1 the first, 2 the second, 3 both
    disturbed_m: Float32[np.ndarray, " t"]  # largest displacement of any other object so far
    moved_ids: tuple[str, ...]  # other objects that ever moved by more than 0.5 mm or 0.5°
    moved_poses: Float32[np.ndarray, "t m 7"]  # their poses, as `object_pose`

    def __len__(self) -> int:
        return len(self.command)

    def poses_of(self, object_id: str) -> Float32[np.ndarray, "t 7"] | None:
        """Return another object's pose at each sample, or None where it stands as exported."""
        if object_id not in self.moved_ids:
            return None
        return self.moved_poses[:, self.moved_ids.index(object_id)]


def encode_recording(recording: Recording) -> bytes:
    """Encode the file; equal recordings give equal bytes."""
    arrays: dict[str, Any] = {name: getattr(recording, name) for name in _ARRAYS if hasattr(recording, name)}
    arrays["format"] = np.frombuffer(FORMAT.encode(), dtype=np.uint8)
    arrays["robot"] = np.frombuffer(recording.robot.encode(), dtype=np.uint8)
    arrays["moved_ids"] = np.frombuffer("\n".join(recording.moved_ids).encode(), dtype=np.uint8)
    arrays["base"] = np.concatenate([recording.base.position, recording.base.quaternion_wxyz])
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        for name, (kind, _) in _ARRAYS.items():
            entry = zipfile.ZipInfo(f"{name}.npy", _DATE)
            entry.create_system, entry.external_attr = 3, 0o644 << 16
            content = io.BytesIO()
            array = np.ascontiguousarray(arrays[name], dtype=kind).reshape(np.shape(arrays[name]))
            np.lib.format.write_array(content, array, version=(1, 0), allow_pickle=False)
            archive.writestr(entry, content.getvalue())
    return file.getvalue()


def decode_recording(data: bytes, name: str = "trajectory") -> Recording:
    """Decode and check a file of any origin; messages call it `name`.

    Raises:
        InputError: `bad_arrays` if it is no such zip, or an array is missing, of another type or shape, not finite, or
            out of bounds.
    """
    try:
        found = _read_members(data)
        length = len(found["command"])
        _check_shapes(found, length)
        _check_values(found)
        return Recording(
            robot=found["robot"].tobytes().decode(),
            base=Pose(found["base"][:3], found["base"][3:]),
            step_s=float(found["step_s"]),
            max_disturbed_m=float(found["max_disturbed_m"]),
            moved_ids=_read_moved_ids(found),
            **{key: found[key] for key in _ARRAYS if key not in _DECODED},
        )
    except (ValueError, zipfile.BadZipFile, zipfile.LargeZipFile, EOFError, NotImplementedError, RuntimeError) as error:
        raise InputError(f"{name}: no arrays of {FORMAT}: {sanitize_line(str(error), 300)}", "bad_arrays") from None


def _read_members(data: bytes) -> dict[str, Any]:
    if len(data) > MAX_BYTES:
        raise ValueError(f"longer than {MAX_BYTES} bytes")
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        entries = {entry.filename: entry for entry in archive.infolist()[: len(_ARRAYS) + 1]}
        if missing := [name for name in _ARRAYS if f"{name}.npy" not in entries]:
            raise ValueError(f"there is no {missing[0]}.npy")
        if len(archive.infolist()) != len(_ARRAYS):
            raise ValueError(f"{len(archive.infolist())} members instead of {len(_ARRAYS)}")
        if packed := [entry.filename for entry in entries.values() if entry.compress_type != zipfile.ZIP_STORED]:
            raise ValueError(f"{packed[0]} is compressed; write it without")
        return {name: _parse_array(name, archive.read(f"{name}.npy")) for name in _ARRAYS}


def _parse_array(name: str, content: bytes) -> Any:
    match = _HEADER.match(content, 0, _MAX_HEADER_BYTES)
    if match is None or len(match[0]) != 10 + int.from_bytes(content[8:10], "little"):
        raise ValueError(f"{name}: its header is not that of a plain array, in .npy of version 1.0")
    kind, order, shape = match[1].decode(), match[2], tuple(int(side) for side in match[3].split(b",") if side.strip())
    expected, dimensions = _ARRAYS[name]
    if len(shape) != dimensions:
        raise ValueError(f"{name}: {len(shape)} dimensions instead of {dimensions}")
    if kind != expected or (order == b"True" and len(shape) > 1):
        raise ValueError(f"{name}: type {kind}, Fortran order {order.decode()}; it has to be {expected}, False")
    body = content[len(match[0]) :]
    if math.prod(shape) * np.dtype(kind).itemsize != len(body):
        raise ValueError(f"{name}: its header says shape {shape}, but {len(body)} bytes follow")
    return np.frombuffer(body, dtype=kind).reshape(shape)


def _read_moved_ids(found: dict[str, Any]) -> tuple[str, ...]:
    """Read one id per line, each safe as an id and distinct."""
    text = found["moved_ids"].tobytes().decode()
    names = tuple(check_id(name) for name in text.split("\n")) if text else ()
    if len(names) != found["moved_poses"].shape[1] or len(set(names)) != len(names):
        raise ValueError(f"moved_ids: {len(set(names))} ids for {found['moved_poses'].shape[1]} objects in moved_poses")
    return names


def _check_shapes(found: dict[str, Any], length: int) -> None:
    if found["format"].tobytes() != FORMAT.encode():
        raise ValueError(f"its format is {found['format'].tobytes()[:60]!r}")
    joints, moving = found["command"].shape[1] - 1, found["qpos"].shape[1]
    if not 1 <= length <= MAX_SAMPLES or not 1 <= joints < moving <= MAX_JOINTS:
        raise ValueError(f"{length} samples of {joints} joints and {moving - joints} fingers")
    if not 1 <= len(found["robot"]) <= MAX_NAME_BYTES or found["base"].shape != (7,):
        raise ValueError(f"robot has {len(found['robot'])} bytes and base the shape {found['base'].shape}")
    if (moved := found["moved_poses"].shape[1]) > MAX_MOVED:
        raise ValueError(f"moved_poses: {moved} objects of at most {MAX_MOVED}")
    rows = {"qpos": (moving,), "qvel": (moving,), "tcp": (7,), "object_pose": (7,), "moved_poses": (moved, 7)}
    for name in ("phase", "time_s", "pads", "disturbed_m", *rows):
        if found[name].shape != (expected := (length, *rows.get(name, ()))):
            raise ValueError(f"{name}: shape {found[name].shape} instead of {expected}")


def _check_values(found: dict[str, Any]) -> None:
    for name, array in found.items():
        if not (np.isfinite(array) & (np.abs(array.astype(np.float64)) <= _MAX_NUMBER)).all():
            raise ValueError(f"{name}: not finite, or beyond {_MAX_NUMBER:g}")
    step_s, bound, phase = float(found["step_s"]), float(found["max_disturbed_m"]), found["phase"]
    if not MIN_STEP_S <= step_s <= MAX_STEP_S or bound < 0.0:
        raise ValueError(f"step_s {step_s}, from {MIN_STEP_S} to {MAX_STEP_S}; max_disturbed_m {bound}")
    if (duration_s := (len(phase) - 1) * step_s) > MAX_DURATION_S + _TIME_TOLERANCE:
        raise ValueError(f"it takes {duration_s:.1f} s, more than {MAX_DURATION_S:g} s")
    if phase.min() < 0 or phase.max() >= len(Phase) or (np.diff(phase) < 0).any():
        raise ValueError(f"phase: has to ascend within 0 and {len(Phase) - 1}")
    if np.abs(found["time_s"] - np.arange(len(phase)) * found["step_s"]).max() > _TIME_TOLERANCE:
        raise ValueError("time_s: is not that of samples step_s apart")
    if found["pads"].max() > 3:
        raise ValueError("pads: 0 to 3")
    for name in ("base", "tcp", "object_pose", "moved_poses"):
        length = np.linalg.norm(found[name].reshape(-1, 7)[:, 3:].astype(np.float64), axis=1)
        if np.abs(length - 1.0).max(initial=0.0) > _QUATERNION_TOLERANCE:
            raise ValueError(f"{name}: a quaternion that is not of unit length")
