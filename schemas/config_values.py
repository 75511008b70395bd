"""Types of the configuration's values, and what each of them refuses."""

import os
import re
from typing import Annotated

from pydantic import AfterValidator, Field

# What a detector with a vocabulary is asked for, besides the table and people
VOCABULARY = (
    *("cup", "mug", "glass", "bottle", "can", "jar", "bowl", "plate", "tray", "basket", "box", "carton", "bag", "tin"),
    *("pot", "pan", "kettle", "teapot", "cutting board", "knife", "fork", "spoon", "chopsticks", "spatula", "napkin"),
    *("fruit", "vegetable", "bread", "cake", "book", "notebook", "paper", "pen", "scissors", "tape", "stapler"),
    *("phone", "laptop", "keyboard", "computer mouse", "remote control", "headphones", "lamp", "clock", "camera"),
    *("toy", "ball", "vase", "plant", "candle", "glasses", "wallet", "keys", "tool", "screwdriver", "hammer", "drill"),
)
MAX_VOCABULARY = 200


def _check_variable_name(name: str) -> str:
    """Check the name of an environment variable; the error does not show it, since it may be a misplaced key."""
    if name and not re.fullmatch(r"[A-Z_][A-Z0-9_]{0,63}", name):
        raise ValueError("must be the NAME of an environment variable, in capitals; never the key itself")
    return name


def _check_vocabulary(labels: tuple[str, ...]) -> tuple[str, ...]:
    twice = sorted({label for label in labels if labels.count(label) > 1})
    if twice:
        raise ValueError(f"{twice[0]!r} stands twice")
    return labels


def _check_interval(bounds: tuple[float, float]) -> tuple[float, float]:
    low, high = bounds
    if low >= high:
        raise ValueError(f"the first, {low:g}, must be less than the second, {high:g}")
    return bounds


Metres = Annotated[float, Field(ge=0.0, le=100.0, allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
Interval = Annotated[tuple[Positive, Positive], AfterValidator(_check_interval)]
KeyVariable = Annotated[str, Field(max_length=4096), AfterValidator(_check_variable_name)]
VocabularyLabel = Annotated[str, Field(max_length=60, pattern=r"^[a-z0-9]+([ '-][a-z0-9]+)*$")]
Vocabulary = Annotated[
    tuple[VocabularyLabel, ...], Field(min_length=1, max_length=MAX_VOCABULARY), AfterValidator(_check_vocabulary)
]
Weights = Annotated[str, Field(max_length=4096), AfterValidator(os.path.expanduser)]
ModelName = Annotated[str, Field(max_length=200, pattern=r"^[A-Za-z0-9._:/@+-]*$")]
