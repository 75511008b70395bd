"""Edges along borders of regions: by the region's own pixels, and unknown where nothing can be measured."""

import numpy as np
import pytest

from tableverse_factory.geometry.math.color_edges import blur_to_lab, measure_color_edges

GREY, RED = (128, 128, 128), (190, 40, 45)


def paint(*regions: tuple[slice, slice, tuple[int, int, int]]) -> tuple[np.ndarray, np.ndarray]:
    color, labels = np.full((60, 160, 3), GREY, np.uint8), np.zeros((60, 160), np.int32)
    for k, (rows, columns, tint) in enumerate(regions, start=1):
        color[rows, columns], labels[rows, columns] = tint, k
    return color, labels


def measure(color: np.ndarray, labels: np.ndarray) -> np.ndarray:
    return measure_color_edges(labels, int(labels.max()), blur_to_lab(color), labels == 0)


def test_a_region_of_the_same_colour_has_no_edge_whatever_lies_beside_it() -> None:
    color, labels = paint((slice(20, 40), slice(20, 40), GREY), (slice(20, 40), slice(44, 70), RED))
    same, other = measure(color, labels)
    assert same < 1.0
    assert other > 40.0


def test_a_region_too_thin_to_have_an_inside_has_no_known_edge() -> None:
    color, labels = paint((slice(20, 22), slice(10, 60), GREY), (slice(20, 40), slice(100, 130), RED))
    thin, wide = measure(color, labels)
    assert np.isnan(thin), "the red region far away is not its inside"
    assert wide > 40.0


def test_a_region_that_fills_the_picture_has_no_border() -> None:
    color, labels = paint((slice(0, 60), slice(0, 160), RED))
    assert np.isnan(measure(color, labels)).all()


@pytest.mark.parametrize("columns", [slice(0, 30), slice(130, 160)])
def test_the_border_of_the_picture_is_no_edge(columns: slice) -> None:
    color, labels = paint((slice(0, 60), columns, GREY))
    assert measure(color, labels)[0] < 1.0
