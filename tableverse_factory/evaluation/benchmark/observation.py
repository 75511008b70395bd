"""Observations whose pictures are drawn when they are looked at: a policy with chunks of actions looks seldom."""

from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np


class LazyObservation(Mapping[str, np.ndarray]):
    """Observation of one step: states at once, pictures at the first look.

    After the step, pictures that nobody looked at are gone: they would show another state.
    """

    def __init__(
        self,
        states: Mapping[str, np.ndarray],
        pictures: Sequence[str],
        draw: Callable[[], Mapping[str, np.ndarray]],
    ) -> None:
        self._known, self._names = dict(states), (*states, *pictures)
        self._draw: Callable[[], Mapping[str, np.ndarray]] | None = draw

    def __getitem__(self, name: str) -> np.ndarray:
        if name not in self._known and name in self._names:
            if self._draw is None:
                raise KeyError(f"{name} of a past step was not looked at then: read it within `act`")
            self._known |= self._draw()
        return self._known[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)

    def expire(self) -> None:
        """Forget how to draw, before the next step."""
        self._draw = None
