"""A frame comes back whole or not at all, from bytes, files and readers of exact lengths."""

import io

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tableverse_factory.core.errors import BuildError
from tableverse_factory.core.framing import FrameError, encode_header, read_frame, scan_frames

FRAMES = st.lists(st.tuples(st.binary(max_size=20), st.binary(max_size=50)), max_size=5)


def encode(frames) -> bytes:
    return b"".join(encode_header(payload, label) + payload for label, payload in frames)


@given(frames=FRAMES, verify=st.booleans())
def test_frames_come_back_in_order(frames, verify):
    file = io.BytesIO(encode(frames))
    spans = list(scan_frames(file, verify=verify))
    assert [(span.label, file.getvalue()[span.offset : span.end]) for span in spans] == frames
    file.seek(0)
    assert [read_frame(file.read) for _ in frames] == frames


@given(frames=FRAMES, cut=st.integers(0, 400), verify=st.booleans())
def test_a_torn_tail_loses_only_the_torn_frame(frames, cut, verify):
    data = encode(frames)[:cut]
    ends = [len(encode(frames[: n + 1])) for n in range(len(frames))]
    assert len(list(scan_frames(io.BytesIO(data), verify=verify))) == sum(end <= len(data) for end in ends)


@given(payload=st.binary(max_size=50), position=st.integers(0, 100), bit=st.integers(0, 7))
def test_a_flipped_bit_is_detected(payload, position, bit):
    data = bytearray(encode([(b"label", payload)]))
    data[position % len(data)] ^= 1 << bit
    with pytest.raises(FrameError):
        read_frame(io.BytesIO(data).read)
    assert list(scan_frames(io.BytesIO(data))) == []


def test_a_long_payload_is_refused_before_it_is_read():
    asked = []
    stream = io.BytesIO(encode([(b"", b"x" * 100)]))
    with pytest.raises(FrameError, match="at most 99"):
        read_frame(lambda n: asked.append(n) or stream.read(n), max_bytes=99)
    assert asked == [18]


@pytest.mark.parametrize("magic", [b"TVJ1", b"TVR1"])
def test_the_format_of_an_older_version_is_refused(magic):
    with pytest.raises(BuildError, match="an older version of TableVerse Factory began this build"):
        list(scan_frames(io.BytesIO(magic + bytes(100))))
