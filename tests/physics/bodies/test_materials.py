"""Mass priors: sensible for household goods, bounded for anything."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tableverse_factory.physics.bodies.materials import (
    MAX_MASS_KG,
    MIN_MASS_KG,
    compute_mass_bounds_kg,
    estimate_mass_kg,
    estimate_rolling_friction_m,
    guess_material,
)

LABELS = st.one_of(st.text(max_size=200), st.sampled_from(["mug", "steel fork", "toy", "wine glass", "box", ""]))
SIZES = st.tuples(*[st.floats(1e-6, 40.0)] * 3).map(np.array)


@given(LABELS, st.floats(0.0, 100.0), SIZES)
def test_every_mass_is_finite_and_within_bounds(label: str, volume: float, size: np.ndarray) -> None:
    assert MIN_MASS_KG <= estimate_mass_kg(label, volume, size) <= MAX_MASS_KG
    low, high = compute_mass_bounds_kg(volume, size)
    assert 0.0 < low < high <= 2 * MAX_MASS_KG


@given(LABELS, SIZES, st.floats(1e-7, 0.1), st.floats(1.0, 10.0))
def test_more_volume_never_weighs_less(label: str, size: np.ndarray, volume: float, factor: float) -> None:
    assert estimate_mass_kg(label, volume, size) <= estimate_mass_kg(label, volume * factor, size)


@pytest.mark.parametrize(
    ("label", "volume_m3", "size_m", "low_kg", "high_kg"),
    [
        ("tomato soup can", 3.4e-4, (0.067, 0.067, 0.102), 0.2, 0.5),  # YCB: 349 g
        ("cracker box", 2.0e-3, (0.06, 0.16, 0.213), 0.3, 0.9),  # YCB: 411 g
        ("mustard bottle", 6.0e-4, (0.058, 0.095, 0.19), 0.4, 0.8),  # YCB: 603 g
        ("banana", 1.0e-4, (0.036, 0.04, 0.19), 0.05, 0.15),
        ("red mug", 5.0e-4, (0.117, 0.083, 0.082), 0.2, 0.5),  # solid in the mesh, hollow in truth
        ("red mug", 9.0e-5, (0.117, 0.083, 0.082), 0.1, 0.3),  # with its cavity
        ("fork", 6.0e-6, (0.02, 0.19, 0.015), 0.02, 0.08),
        ("bowl", 1.0e-3, (0.16, 0.16, 0.055), 0.2, 0.8),
    ],
)
def test_masses_of_known_things(
    label: str, volume_m3: float, size_m: tuple[float, float, float], low_kg: float, high_kg: float
) -> None:
    assert low_kg <= estimate_mass_kg(label, volume_m3, np.array(size_m)) <= high_kg


def test_matter_comes_before_kind_and_plurals_count() -> None:
    assert guess_material("wooden bowl").name == "wood"
    assert guess_material("two APPLES").name == "food"
    assert guess_material('"/><x a=').name == guess_material("nothing known").name


@pytest.mark.parametrize(
    ("many", "one"),
    [("wine glasses", "wine glass"), ("dishes", "dish"), ("knives", "knife"), ("strawberries", "strawberry")],
)
def test_several_are_of_the_same_matter_as_one(many: str, one: str) -> None:
    assert guess_material(many) == guess_material(one) != guess_material("nothing known")


def test_a_word_inside_a_word_is_not_that_word() -> None:
    assert guess_material("candle") != guess_material("can")
    assert guess_material("cupboard") != guess_material("cup")


@given(LABELS, SIZES, st.floats(1.1, 10.0))
def test_rolling_friction_grows_with_the_radius_alone(label: str, size: np.ndarray, factor: float) -> None:
    friction = estimate_rolling_friction_m(label, size)
    assert 0.0 < friction <= size.min()
    assert estimate_rolling_friction_m(label, factor * size) == pytest.approx(factor * friction)
