"""The motions that are learnt: of so many scenes, of each as many, and smaller choices within larger ones."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tableverse_factory.core.errors import InputError
from tableverse_factory.evaluation.training.policy.choose_motions import choose_motions
from tableverse_factory.evaluation.training.policy.demonstrations import Demonstrations

SCENES = np.array([0, 0, 0, 1, 2, 2, 3, 3], dtype=np.int32)
HELD_OUT = np.array([0, 0, 0, 0, 1, 1, 0, 0], dtype=np.uint8)


@pytest.fixture
def own(packed: Path) -> Demonstrations:
    """Three scenes to learn from, with three, one and two motions, and one that is held out."""
    return replace(Demonstrations.read(packed), scenes=SCENES, held_out=HELD_OUT, ends=np.arange(1, 9, dtype=np.int32))


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("scenes", "motions", "chosen"),
    [
        (None, None, [0, 1, 2, 3, 6, 7]),
        (2, None, [0, 1, 2, 3]),
        (None, 3, [0, 3, 6]),
        (None, 4, [0, 1, 3, 6]),
        (2, 3, [0, 1, 3]),
        (1, 2, [0, 1]),
    ],
)
def test_scenes_give_motions_in_turn(own: Demonstrations, scenes: int, motions: int, chosen: list[int]) -> None:
    assert np.flatnonzero(choose_motions(own, scenes, motions)).tolist() == chosen


@pytest.mark.heavy
def test_more_than_there_are_is_refused(own: Demonstrations) -> None:
    with pytest.raises(InputError, match="4 scenes are to be learnt, and 3 have motions"):
        choose_motions(own, scenes=4)
    with pytest.raises(InputError, match="5 motions are to be learnt, and the 2 scenes have 4"):
        choose_motions(own, scenes=2, motions=5)
