"""The files of motions: what is written is read again, bytes are equal, and what is hostile is named and refused."""

import io
import zipfile
from contextlib import suppress
from dataclasses import fields, replace

import numpy as np
import pytest

from schemas.geometry import Pose
from tableverse_factory.core.errors import InputError
from tableverse_factory.robotics.execution import arrays
from tableverse_factory.robotics.execution.arrays import FORMAT, Recording, decode_recording, encode_recording

LENGTH = 7


@pytest.fixture
def recording() -> Recording:
    rng = np.random.default_rng(5)
    pose = np.concatenate([rng.normal(size=(LENGTH, 3)), np.tile([0.6, 0.0, 0.8, 0.0], (LENGTH, 1))], axis=1)
    return Recording(
        robot="panda",
        base=Pose(rng.normal(size=3), np.array([0.6, 0.0, 0.0, 0.8])),
        step_s=0.02,
        max_disturbed_m=0.02,
        command=rng.normal(size=(LENGTH, 8)),
        phase=np.array([0, 0, 1, 2, 3, 4, 5], dtype=np.int32),
        time_s=(np.arange(LENGTH) * 0.02).astype(np.float32),
        qpos=rng.normal(size=(LENGTH, 9)).astype(np.float32),
        qvel=rng.normal(size=(LENGTH, 9)).astype(np.float32),
        tcp=pose.astype(np.float32),
        object_pose=pose.astype(np.float32),
        pads=np.array([0, 0, 3, 3, 3, 1, 0], dtype=np.uint8),
        disturbed_m=np.linspace(0.0, 0.001, LENGTH).astype(np.float32),
        moved_ids=("obj_003", "mug.b"),
        moved_poses=np.stack([pose, pose[::-1]], axis=1).astype(np.float32),
    )


def members(data: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def packed(files: dict[str, bytes], method: int = zipfile.ZIP_STORED) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", method) as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return file.getvalue()


def npy(array: object, **options: object) -> bytes:
    file = io.BytesIO()
    np.save(file, np.asarray(array), **options)
    return file.getvalue()


def ids(text: str) -> np.ndarray:
    return np.frombuffer(text.encode(), dtype=np.uint8)


def test_what_is_written_is_read_bit_by_bit(recording: Recording) -> None:
    read = decode_recording(encode_recording(recording))
    for field in fields(Recording):
        before, after = getattr(recording, field.name), getattr(read, field.name)
        if isinstance(before, np.ndarray):
            assert before.dtype == after.dtype
            assert np.array_equal(before, after)
    assert np.array_equal(read.base.position, recording.base.position)
    assert np.array_equal(read.base.quaternion_wxyz, recording.base.quaternion_wxyz)
    assert (read.robot, read.step_s, read.max_disturbed_m) == ("panda", 0.02, 0.02)
    assert read.moved_ids == recording.moved_ids
    assert encode_recording(read) == encode_recording(recording)


def test_numpy_reads_it_without_pickle(recording: Recording) -> None:
    with np.load(io.BytesIO(encode_recording(recording)), allow_pickle=False) as found:
        assert found["format"].tobytes() == FORMAT.encode()
        assert found["robot"].tobytes() == b"panda"
        assert found["base"].shape == (7,)
        assert found["command"].shape == (LENGTH, 8)
        assert found["step_s"] == 0.02


def test_no_clock_is_in_the_bytes(recording: Recording) -> None:
    with zipfile.ZipFile(io.BytesIO(encode_recording(recording))) as archive:
        assert {entry.date_time for entry in archive.infolist()} == {(1980, 1, 1, 0, 0, 0)}
        assert {entry.compress_type for entry in archive.infolist()} == {zipfile.ZIP_STORED}


@pytest.mark.parametrize(
    ("name", "value", "found"),
    [
        ("command", np.full((LENGTH, 8), np.nan), "command: not finite"),
        ("command", np.full((LENGTH, 8), 1e300), "command: not finite, or beyond"),
        ("command", np.zeros((LENGTH, 8), dtype=np.float32), "command: type <f4"),
        ("command", np.asfortranarray(np.zeros((LENGTH, 8))), "Fortran order True"),
        ("command", np.zeros((0, 8)), "0 samples"),
        ("command", np.zeros((LENGTH, 1)), "0 joints"),
        ("command", np.zeros(LENGTH), "1 dimensions"),
        ("command", np.zeros((LENGTH, 12)), "-2 fingers"),
        ("qvel", np.zeros((LENGTH, 8), dtype=np.float32), "qvel: shape"),
        ("tcp", np.zeros((LENGTH, 7), dtype=np.float32), "tcp: a quaternion"),
        ("base", np.zeros(6), "base the shape"),
        ("base", np.zeros(7), "base: a quaternion"),
        ("phase", np.array([0, 1, 0, 1, 2, 3, 4], dtype=np.int32), "phase: has to ascend"),
        ("phase", np.full(LENGTH, 6, dtype=np.int32), "phase: has to ascend within 0 and 5"),
        ("time_s", np.zeros(LENGTH, dtype=np.float32), "time_s"),
        ("step_s", np.float64(0.0), "step_s 0.0"),
        ("step_s", np.float64(0.2), "step_s 0.2, from 0.004 to 0.1"),
        ("step_s", np.float64(1e-9), "step_s 1e-09"),
        ("moved_ids", ids("obj_003"), "1 ids for 2 objects"),
        ("moved_ids", ids("obj_003\nobj_003"), "1 ids for 2 objects"),
        ("moved_ids", ids(""), "0 ids for 2 objects"),
        ("moved_ids", ids("obj_003\n../../x"), "is not usable"),
        ("moved_ids", np.full(9, 255, dtype=np.uint8), "can't decode"),
        ("moved_poses", np.zeros((LENGTH, 2, 7), dtype=np.float32), "moved_poses: a quaternion"),
        ("moved_poses", np.zeros((LENGTH, 14), dtype=np.float32), "moved_poses: 2 dimensions instead of 3"),
        ("moved_poses", np.ones((LENGTH - 1, 2, 7), dtype=np.float32), "moved_poses: shape"),
        ("moved_poses", np.full((LENGTH, 2, 7), np.inf, dtype=np.float32), "moved_poses: not finite"),
        ("moved_poses", np.zeros((1, 2000, 7), dtype=np.float32), "2000 objects of at most 1000"),
        ("step_s", np.float64(-np.inf), "step_s: not finite"),
        ("max_disturbed_m", np.float64(-1.0), "max_disturbed_m -1.0"),
        ("pads", np.full(LENGTH, 9, dtype=np.uint8), "pads: 0 to 3"),
        ("format", np.frombuffer(b"tableverse-trajectory-9", dtype=np.uint8), "its format is"),
        ("robot", np.zeros(0, dtype=np.uint8), "robot has 0 bytes"),
        ("robot", np.full(4, 255, dtype=np.uint8), "can't decode"),
        ("object_pose", np.array([{}] * LENGTH, dtype=object), "object_pose: its header"),
    ],
)
def test_what_is_wrong_is_named(recording: Recording, name: str, value: object, found: str) -> None:
    files = members(encode_recording(recording))
    files[f"{name}.npy"] = npy(value)
    with pytest.raises(InputError, match="no arrays of tableverse-trajectory-1") as caught:
        decode_recording(packed(files), "trajectories/task_000.npz")
    assert found in str(caught.value)
    assert caught.value.reason == "bad_arrays"
    assert str(caught.value).startswith("trajectories/task_000.npz")


def test_bombs_and_rubbish_are_refused(recording: Recording, monkeypatch: pytest.MonkeyPatch) -> None:
    good = encode_recording(recording)
    files = members(good)
    vast, lying = (files["command.npy"].replace(b"(7, 8)", shape) for shape in (b"(9**9)", b"(9, 8)"))
    hostile = [
        b"",
        b"PK\x03\x04",
        good[:-40],
        good[40:],
        packed({**files, "more.npy": b""}),
        packed({name: data for name, data in files.items() if name != "tcp.npy"}),
        packed(files, zipfile.ZIP_DEFLATED),
        packed({**files, "command.npy": b"\x93NUMPY\x01\x00\xff\xff{" + b"(" * 60000}),
        packed({**files, "command.npy": vast}),
        packed({**files, "command.npy": lying}),
        packed({**files, "command.npy": files["command.npy"][:-8]}),
        packed({**files, "command.npy": b""}),
    ]
    for data in hostile:
        with pytest.raises(InputError):
            decode_recording(data)
    for place in range(0, len(good), 97):  # one flipped byte is found by the zip's own sums, or leaves what is valid
        flipped = bytearray(good)
        flipped[place] ^= 0x55
        with suppress(InputError):
            decode_recording(bytes(flipped))
    monkeypatch.setattr(arrays, "MAX_BYTES", len(good) - 1)
    with pytest.raises(InputError, match="longer than"):
        decode_recording(good)


def test_a_long_recording_stays_small(recording: Recording) -> None:
    """Ten seconds at 50 Hz are less than 200 kB."""
    few = np.repeat(recording.moved_poses[:1, :1], 500, axis=0)
    rows = {name: np.repeat(getattr(recording, name)[:1], 500, axis=0) for name in ("command", "qpos", "qvel", "tcp")}
    flat = {name: np.repeat(getattr(recording, name)[:1], 500) for name in ("phase", "pads", "disturbed_m")}
    long = replace(
        recording,
        **rows,
        **flat,
        object_pose=rows["tcp"],
        time_s=(np.arange(500) * 0.02).astype(np.float32),
        moved_ids=("obj_003",),
        moved_poses=few,
    )
    assert len(encode_recording(long)) < 200_000
    assert len(encode_recording(long)) - len(encode_recording(unmoved(long))) == 500 * 28 + len("obj_003")


def unmoved(recording: Recording) -> Recording:
    return replace(recording, moved_ids=(), moved_poses=np.zeros((len(recording), 0, 7), dtype=np.float32))


def test_nothing_moved_is_read_too(recording: Recording) -> None:
    read = decode_recording(encode_recording(unmoved(recording)))
    assert (read.moved_ids, read.moved_poses.shape) == ((), (LENGTH, 0, 7))


@pytest.mark.parametrize(("step_s", "samples", "fits"), [(0.1, 1201, True), (0.1, 1202, False), (0.004, 30_002, False)])
def test_no_recording_takes_longer_than_two_minutes(
    recording: Recording, step_s: float, samples: int, fits: bool
) -> None:
    names = ("command", "phase", "qpos", "qvel", "tcp", "object_pose", "pads", "disturbed_m")
    columns = {name: np.repeat(getattr(recording, name)[-1:], samples, axis=0) for name in names}
    times = (np.arange(samples) * step_s).astype(np.float32)
    long = unmoved(replace(recording, **columns, step_s=step_s, time_s=times))
    if fits:
        assert len(decode_recording(encode_recording(long))) == samples
    else:
        with pytest.raises(InputError, match=r"more than 120 s|30002 samples"):
            decode_recording(encode_recording(long))
