"""Messages of a sandbox survive a round trip; bytes that are no message are refused."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.codec import encode
from schemas.outcome import Dropped, Failed, ModelCost
from schemas.work import ScenePart, StageReport, StageTiming
from workers.sandbox.messages import InputMissing, StageDone, decode_message, encode_message

seconds = st.floats(0, 1e6)
spent = st.builds(ModelCost, st.integers(0, 99), st.integers(0, 9**9), st.integers(0, 9**9), st.floats(0, 1e3))


@pytest.mark.parametrize("output", ["shard-00000/a.look.0", ScenePart("0123.parts", 7, 100, 1000)])
@given(cpu_s=seconds, wall_s=seconds, total_s=seconds, cost=spent, paid=spent)
def test_finished_stage_round_trip(output, cpu_s, wall_s, total_s, cost, paid):
    done = StageDone(StageReport(None, 1, cpu_s, wall_s, "", cost, paid), total_s, output)
    assert decode_message(encode_message(done)) == done


@pytest.mark.parametrize(
    "message",
    [
        StageReport(Dropped("not_at_rest", "drift 0.5 m"), 1, 0.1, 0.2),
        StageReport(Failed("exception", "ValueError: …"), 1, 0.1, 0.2, "a trace"),
        Failed("BuildError", "cannot write"),
        InputMissing(),
    ],
)
def test_other_messages_round_trip(message):
    assert decode_message(encode_message(message)) == message


@pytest.mark.parametrize(
    "forged",
    [
        b"",
        b"d123",
        b"d[1, 2, 3]",
        b'd["1", 2, 3, 0, 0, 0, 0, 0, 0, 0, 0, ""]',
        b"d[1, 2, 3, 0, 0, 0, 0, 0, 0, 0, 0, 5]",
        b"r",
        b"x" + encode("x"),
        b"r" + encode(StageTiming("a", 1.0, 1.0)),
        b"b" + encode("x"),
    ],
)
def test_invalid_messages_are_refused(forged):
    with pytest.raises(ValueError, match=r"\S"):
        decode_message(forged)
