"""Colours as people say them: what is white stays white in any light, and no hue loses its name."""

import colorsys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.config import CurateConfig
from schemas.geometry import TriangleMesh
from tableverse_factory.stages.curate.appearance import measure_color_shares
from tableverse_factory.stages.curate.judge_input import build_judge_input
from tableverse_factory.stages.curate.phrases import ObjectNamer
from tests.helpers.curate_scenes import BLUE, RED, Thing, ball, box, settled, vessel


def name_of(rgb: tuple[int, int, int]) -> str:
    shares = measure_color_shares(box(0.1, 0.1, 0.1, rgb))
    return max(shares, key=lambda name: shares[name])


def test_colours_count_by_their_area() -> None:
    """A red square of four times the area of a blue one, and a green vertex that belongs to nothing."""
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)
    vertices = np.concatenate([2 * corners, corners + np.array([5.0, 0, 0]), [[9.0, 9, 9]]])
    colors = np.array([[200, 0, 0]] * 4 + [[0, 0, 200]] * 4 + [[0, 200, 0]], dtype=np.uint8)
    shares = measure_color_shares(TriangleMesh(vertices, np.concatenate([faces, faces + np.int32(4)]), colors))
    assert {name: share for name, share in shares.items() if share} == pytest.approx({"red": 0.8, "blue": 0.2})


@pytest.mark.parametrize("tint", [(189, 227, 238), (185, 221, 251), (235, 235, 235), (255, 240, 220), (230, 240, 250)])
def test_a_pale_light_tint_is_white(tint: tuple[int, int, int]) -> None:
    assert name_of(tint) == "white"


@given(hue=st.floats(0, 1), light=st.integers(220, 255), cast=st.floats(0, 0.13))
def test_light_of_any_hue_leaves_a_light_thing_white(hue: float, light: int, cast: float) -> None:
    assert name_of(rgb_of(hue, cast, light)) == "white"


@given(hue=st.floats(0, 1), value=st.integers(120, 255))
def test_no_hue_in_earnest_is_white(hue: float, value: int) -> None:
    assert name_of(rgb_of(hue, 0.5, value)) != "white"


def rgb_of(hue: float, saturation: float, value: int) -> tuple[int, int, int]:
    red, green, blue = (round(value * part) for part in colorsys.hsv_to_rgb(hue, saturation, 1.0))
    return red, green, blue


@pytest.mark.parametrize(
    ("rgb", "name"),
    [
        ((135, 206, 235), "blue"),
        ((255, 182, 193), "pink"),
        ((240, 230, 140), "yellow"),
        ((152, 251, 152), "green"),
        ((128, 128, 128), "grey"),
        ((20, 20, 30), "black"),
    ],
)
def test_pale_is_not_washed_out(rgb: tuple[int, int, int], name: str) -> None:
    assert name_of(rgb) == name


def phrases_of(things: list[Thing]) -> list[tuple[str, ...]]:
    namer = ObjectNamer(
        build_judge_input(settled(things, (1, 1)), CurateConfig()).items, tuple(thing.score for thing in things)
    )
    return [namer.phrases(index) for index in range(len(things))]


def test_who_counts_objects_counts_everything() -> None:
    """Among three things without a name stands a mug: it is the second object from the left."""
    lumps = [lump(x) for x in (-0.3, 0.1, 0.3)]
    phrases = phrases_of([lumps[0], Thing("mug", vessel(0.04, 0.09), -0.1), *lumps[1:]])
    assert "the third object from the left" in phrases[2]
    assert not any("second" in phrase for phrase in phrases[2])
    assert "the rightmost object" in phrases[3]


@pytest.mark.heavy
def test_nobody_counts_what_only_may_be_meant() -> None:
    """A thing that is a third blue is counted by some among the blue ones: then no ordinal is of any use."""
    clear = [Thing("cup", vessel(0.04, 0.08, color=BLUE), x) for x in (-0.3, -0.1, 0.1)]
    motley = ball(0.03, RED)
    colors = np.where(motley.vertices[:, 2:] > 0.008, BLUE, RED).astype(np.uint8)
    doubtful = Thing("cup", TriangleMesh(motley.vertices, motley.faces, colors), 0.3)
    assert "the second blue cup from the left" in phrases_of(clear)[1]
    assert not any("blue cup from the left" in phrase for phrase in phrases_of([*clear, doubtful])[1])
    assert "the second cup from the left" in phrases_of([*clear, doubtful])[1]
    # Asked for the blue cup, nobody takes the red one that is blue in part.
    assert phrases_of([clear[0], doubtful])[0][0] == "the blue cup"


def lump(x: float) -> Thing:
    """Neither box nor ball nor cylinder, and called nothing."""
    solid = box(0.06, 0.06, 0.1)
    corners = solid.vertices * np.where(solid.vertices[:, 2:] > 0, [[0.25, 0.25, 1.0]], 1.0)
    return Thing("object", TriangleMesh(corners, solid.faces), x, score=0.2)
