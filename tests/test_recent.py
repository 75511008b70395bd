"""Remembered answers: found by content, forgotten in turn, never mixed up."""

import numpy as np
import pytest

from schemas.geometry import TriangleMesh
from tableverse_factory.recent import recent

TRIANGLE = np.array([[0, 1, 2]], dtype=np.int32)


def mesh(height: float) -> TriangleMesh:
    return TriangleMesh(np.array([[0.0, 0, 0], [1, 0, 0], [0, height, 0]]), TRIANGLE.copy())


def test_a_copy_of_the_same_content_is_known_and_other_content_is_not() -> None:
    asked: list[float] = []

    @recent(8)
    def height_of(shape: TriangleMesh, scale: float) -> float:
        asked.append(scale)
        return float(shape.vertices[:, 1].max()) * scale

    assert [height_of(mesh(2.0), 1.0), height_of(mesh(2.0), 1.0)] == [2.0, 2.0]
    assert len(asked) == 1
    assert [height_of(mesh(3.0), 1.0), height_of(mesh(2.0), 0.5)] == [3.0, 1.0]
    assert len(asked) == 3


def test_arrays_of_the_same_bytes_but_another_kind_are_kept_apart() -> None:
    @recent(8)
    def described(values: np.ndarray, parts: tuple[str, ...]) -> str:
        return f"{values.dtype} {values.shape} {parts}"

    flat = np.zeros(4, dtype=np.int64)
    found = {described(array, ()) for array in (flat, flat.reshape(2, 2), flat.view(np.float64))}
    assert len(found) == 3
    assert described(flat, ("a", "bc")) != described(flat, ("ab", "c"))


def test_the_oldest_answer_is_forgotten_first() -> None:
    asked: list[int] = []

    @recent(2)
    def same(number: int) -> int:
        asked.append(number)
        return number

    assert [same(number) for number in (1, 2, 1, 3, 1, 2)] == [1, 2, 1, 3, 1, 2]
    assert asked == [1, 2, 3, 2]


def test_a_failure_is_not_remembered_and_what_has_no_content_is_refused() -> None:
    @recent(2)
    def inverse(number: float) -> float:
        return 1 / number

    for _ in range(2):
        with pytest.raises(ZeroDivisionError):
            inverse(0.0)
    with pytest.raises(TypeError, match="object has no content"):
        recent(2)(repr)(object())
