"""Errors name the topic of the documentation that explains them."""

import pickle

import pytest

from tableverse_factory.core.errors import AnswerInvalidError, InputError, StoreError, TableverseError


@pytest.mark.parametrize(
    ("error", "topic"),
    [
        (InputError("m"), "bad-input"),
        (InputError("m", "bad_input"), "bad-input"),
        (InputError("m", "depth_not_16_bit"), "depth_not_16_bit"),
        (InputError("m", "depth_not_16_bit", topic="captures"), "captures"),
        (AnswerInvalidError("m"), "model-answer"),
        (AnswerInvalidError("m", "no_table_detected"), "no_table_detected"),
        (StoreError("m"), "object-store"),
        (StoreError("m", topic="one-writer"), "one-writer"),
    ],
)
def test_topic_is_the_class_s_the_reason_or_the_given_one(error: TableverseError, topic: str) -> None:
    travelled = pickle.loads(pickle.dumps(error))
    assert (error.topic, str(error)) == (travelled.topic, str(travelled)) == (topic, "m")


def test_reason_defaults_to_the_class_s() -> None:
    assert (InputError("m").reason, InputError("m", "bad_mesh").reason) == ("bad_input", "bad_mesh")
    assert AnswerInvalidError("m").reason == "answer_invalid"
