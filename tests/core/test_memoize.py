"""Memoized results: found by content, evicted in turn, never mixed up."""

import gc
import weakref
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from schemas.geometry import Texture, TriangleMesh
from tableverse_factory.core.memoize import clear_caches, measure_bytes, memoize_by_content
from tableverse_factory.physics.mjcf.shape import make_body_shape

TRIANGLE = np.array([[0, 1, 2]], dtype=np.int32)


def mesh(height: float) -> TriangleMesh:
    return TriangleMesh(np.array([[0.0, 0, 0], [1, 0, 0], [0, height, 0]]), TRIANGLE.copy())


def test_a_copy_of_the_same_content_is_known_and_other_content_is_not() -> None:
    asked: list[float] = []

    @memoize_by_content(10_000)
    def height_of(shape: TriangleMesh, scale: float) -> float:
        asked.append(scale)
        return float(shape.vertices[:, 1].max()) * scale

    assert [height_of(mesh(2.0), 1.0), height_of(mesh(2.0), 1.0)] == [2.0, 2.0]
    assert len(asked) == 1
    assert [height_of(mesh(3.0), 1.0), height_of(mesh(2.0), 0.5)] == [3.0, 1.0]
    assert len(asked) == 3


def test_arrays_of_the_same_bytes_but_another_kind_are_kept_apart() -> None:
    @memoize_by_content(10_000)
    def described(values: np.ndarray, parts: tuple[str, ...]) -> str:
        return f"{values.dtype} {values.shape} {parts}"

    flat = np.zeros(4, dtype=np.int64)
    found = {described(array, ()) for array in (flat, flat.reshape(2, 2), flat.view(np.float64))}
    assert len(found) == 3
    assert described(flat, ("a", "bc")) != described(flat, ("ab", "c"))


def test_the_oldest_answer_is_forgotten_first() -> None:
    asked: list[int] = []

    @memoize_by_content(2_500)
    def filled(number: int) -> np.ndarray:
        asked.append(number)
        return np.full(1_000, number, dtype=np.uint8)

    assert [filled(number)[0] for number in (1, 2, 1, 3, 1, 2)] == [1, 2, 1, 3, 1, 2]
    assert asked == [1, 2, 3, 2]
    clear_caches()
    assert filled(1)[0] == 1
    assert asked == [1, 2, 3, 2, 1]


def test_what_is_kept_is_bounded_by_its_size() -> None:
    """A view counts with all that it keeps alive, and what is larger than the bound is not kept at all."""
    asked: list[int] = []

    @memoize_by_content(100_000)
    def end_of(size: int) -> TriangleMesh:
        asked.append(size)
        return TriangleMesh(np.zeros((size, 3))[-3:], TRIANGLE)

    for size in (100, 10_000, 100, 10_000, 100):
        end_of(size)
    assert asked == [100, 10_000, 10_000]
    assert measure_bytes(end_of(10_000)) > 240_000


def test_pictures_of_a_shape_are_not_kept_and_come_back_with_it() -> None:
    box = trimesh.creation.box((0.1, 0.1, 0.1))
    bare = TriangleMesh(np.array(box.vertices), np.array(box.faces, dtype=np.int32))
    pictures = [np.full((50, 80, 3), shade, np.uint8) for shade in (1, 2)]
    held = [weakref.ref(picture) for picture in pictures]
    for shade in (1, 2):
        colors = np.full((8, 3), shade, dtype=np.uint8)
        painted = replace(bare, vertex_colors=colors, texture=Texture(pictures.pop(0), np.zeros((12, 3, 2))))
        shape = make_body_shape(painted, (bare,), 2.0)
        assert shape.mesh.texture is painted.texture
        np.testing.assert_array_equal(shape.mesh.vertex_colors, colors)
        np.testing.assert_allclose(shape.mesh.vertices, 2.0 * bare.vertices)
        assert shape.moments is make_body_shape(bare, (bare,), 2.0).moments
    del painted, shape
    gc.collect()
    assert [reference() for reference in held] == [None, None]


def test_a_failure_is_not_remembered_and_what_has_no_content_is_refused() -> None:
    @memoize_by_content(10_000)
    def inverse(number: float) -> float:
        return 1 / number

    for _ in range(2):
        with pytest.raises(ZeroDivisionError):
            inverse(0.0)
    with pytest.raises(TypeError, match="object cannot be hashed"):
        memoize_by_content(10_000)(repr)(object())
