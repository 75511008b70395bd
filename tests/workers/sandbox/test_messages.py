"""What a sandbox says is understood as it was meant; what nobody said is refused."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.codec import encode
from schemas.outcome import Dropped, Failed
from schemas.work import StageReport, StageTiming
from workers.sandbox.messages import InputMissing, StageDone, decode_message, encode_message

seconds = st.floats(0, 1e6)


@given(cpu_s=seconds, wall_s=seconds, total_s=seconds)
def test_a_stage_that_is_done_keeps_its_times(cpu_s, wall_s, total_s):
    done = StageDone(StageReport(None, 1, cpu_s, wall_s), total_s)
    assert decode_message(encode_message(done)) == done


@pytest.mark.parametrize(
    "what",
    [
        StageReport(Dropped("not_at_rest", "drift 0.5 m"), 1, 0.1, 0.2),
        StageReport(Failed("exception", "ValueError: …"), 1, 0.1, 0.2, "a trace"),
        Failed("BuildError", "cannot write"),
        InputMissing(),
    ],
)
def test_everything_else_is_said_in_full(what):
    assert decode_message(encode_message(what)) == what


@pytest.mark.parametrize(
    "forged", [b"", b"d123", b"r", b"x" + encode("x"), b"r" + encode(StageTiming("a", 1.0, 1.0)), b"b" + encode("x")]
)
def test_what_nobody_said_is_refused(forged):
    with pytest.raises(ValueError, match=r"\S"):
        decode_message(forged)
