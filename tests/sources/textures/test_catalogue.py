"""Procedural table-tops: the same bytes everywhere, no seams, none like another, quick."""

import hashlib
import io
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from tableverse_factory.core.errors import InputError
from tableverse_factory.sources.textures.catalogue import (
    FAMILIES,
    TEXTURE_COUNT,
    make_texture,
    name_texture,
    parse_texture_seed,
)
from tests.helpers.texture_perception import MIN_DISTANCE, descriptor, distance, nearest_distances

DIGEST = "8ca2400b14605073437ae7ec5da4de146820434fb67c74e789b5d71228f98884"
"""Of the first member of each family at 64 px. A change of any family changes it: datasets made before then differ."""


def test_the_bytes_are_the_same_on_every_machine():
    digest = hashlib.sha256()
    for seed in range(len(FAMILIES)):
        digest.update(make_texture(seed, 64).tobytes())
    assert digest.hexdigest() == DIGEST


@pytest.mark.parametrize("family", FAMILIES)
def test_it_repeats_without_a_seam(family):
    """The step over the edge is no larger than the largest within."""
    for number in (0, 5):
        picture = make_texture(parse_texture_seed(f"{family}-{number}"), 192).astype(np.float64)
        for axis in (0, 1):
            steps = np.abs(picture - np.roll(picture, 1, axis=axis)).mean(axis=(1 - axis, 2))
            assert steps[0] <= 1.15 * steps[1:].max() + 0.5


@pytest.mark.parametrize("family", FAMILIES)
def test_a_small_one_is_a_large_one_seen_from_afar(family):
    seed = parse_texture_seed(f"{family}-3")
    small, large = make_texture(seed, 128), make_texture(seed, 512)
    means = small.mean(axis=(0, 1)), large.mean(axis=(0, 1))
    assert np.abs(means[0] - means[1]).max() < 8.0
    assert large.dtype == np.uint8
    assert large.shape == (512, 512, 3)


@pytest.mark.heavy
def test_a_hundred_look_different():
    gaps, _ = nearest_distances([descriptor(make_texture(seed, 128)) for seed in range(96)])
    assert gaps.min() >= MIN_DISTANCE


@pytest.mark.slow
def test_all_of_them_look_different():
    assert TEXTURE_COUNT > 1700
    gaps, partner = nearest_distances([descriptor(make_texture(seed)) for seed in range(TEXTURE_COUNT)])
    worst = int(gaps.argmin())
    assert gaps.min() >= MIN_DISTANCE, f"{name_texture(worst)} and {name_texture(int(partner[worst]))}"


@pytest.mark.slow  # a figure of time
@pytest.mark.heavy
def test_a_hundred_take_less_than_ten_seconds():
    start = time.process_time()
    for seed in range(100):
        make_texture(seed, 512)
    assert time.process_time() - start < 10.0


def test_the_distance_of_plain_greys_is_their_difference_in_lightness():
    lighter, darker = (np.full((128, 128, 3), value, dtype=np.uint8) for value in (119, 94))  # L* of 50.0 and 39.9
    assert distance(lighter, darker) == pytest.approx(10.1, abs=0.2)
    assert distance(lighter, lighter) == 0.0


@pytest.mark.heavy
@settings(max_examples=15, deadline=None)
@given(st.integers(0, TEXTURE_COUNT - 1), st.integers(0, 127), st.integers(0, 127))
def test_the_same_texture_shifted_or_stored_again_is_nearer_than_any_other(seed, right, down):
    picture = make_texture(seed, 256)
    assert distance(picture, np.roll(picture, (2 * down, 2 * right), axis=(0, 1))) < 1e-9
    jpeg = io.BytesIO()
    Image.fromarray(picture).save(jpeg, "JPEG", quality=95, subsampling=0)
    assert distance(picture, np.asarray(Image.open(jpeg))) < MIN_DISTANCE


@given(st.integers(0, 2**40))
def test_names_stand_for_seeds(seed):
    assert parse_texture_seed(name_texture(seed)) == seed
    assert parse_texture_seed(str(seed)) == parse_texture_seed(seed) == seed


@pytest.mark.parametrize(
    "name", ["", "marble", "marble-", "-3", "marbel-3", "marble--3", "../x-1", "٣", "9" * 30, "1.5"]
)
def test_what_is_no_name_is_said(name):
    with pytest.raises(InputError, match="no texture"):
        parse_texture_seed(name)


@pytest.mark.parametrize(
    ("name", "advice"),
    [("marbel-3", "did you mean marble?"), ("Metal-1", "did you mean brushed_metal?"), ("xyz-1", "families are")],
)
def test_the_nearest_families_are_suggested(name, advice):
    with pytest.raises(InputError) as caught:
        parse_texture_seed(name)
    assert advice in str(caught.value)


def test_what_cannot_be_made_is_said():
    for size in (0, 15, 10**6):
        with pytest.raises(InputError, match="px"):
            make_texture(0, size)
    for seed in (-1, True, 1.0, 2**63):
        with pytest.raises(InputError, match="whole number"):
            make_texture(seed)
    with pytest.raises(InputError, match="square"):
        descriptor(np.zeros((128, 64, 3), dtype=np.uint8))
