"""Hashes that survive what pictures go through, near ones found as a full comparison finds them, and thresholds."""

import io

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image, ImageFilter

from schemas.manifest import ImageRow
from tableverse_factory.cli.manifest import _print_manifest
from tableverse_factory.sources.manifest import Manifest
from tableverse_factory.sources.urls.image_filter import (
    FilterCriteria,
    ImageStats,
    filter_rows,
    find_rejection,
    measure_image,
)
from tableverse_factory.sources.urls.near_duplicates import MAX_BITS, find_near_duplicates
from tableverse_factory.sources.urls.phash import compute_phash
from tests.helpers.picture_server import photo

SAME = FilterCriteria().near_bits


def hash_of(image: Image.Image) -> int:
    return compute_phash(np.asarray(image))


def again(image: Image.Image, quality: int) -> Image.Image:
    out = io.BytesIO()
    image.save(out, "JPEG", quality=quality)
    return Image.open(out).convert("RGB")


CHANGES = {
    "quality": lambda image: again(image, 30),
    "half": lambda image: image.resize((image.width // 2, image.height // 2)),
    "stretched": lambda image: image.resize((image.width // 2, image.height)),
    "darker": lambda image: image.point(lambda level: int(level * 0.7)),
    "grey": lambda image: image.convert("L").convert("RGB"),
    "softer": lambda image: image.filter(ImageFilter.GaussianBlur(2)),
}


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("seed", range(4))
def test_a_hash_survives_what_copies_go_through(seed, change):
    image = photo(seed)
    assert (hash_of(image) ^ hash_of(CHANGES[change](image))).bit_count() <= SAME


def test_different_pictures_and_turned_ones_are_far_apart():
    hashes = [hash_of(photo(seed)) for seed in range(20)]
    turned = [hash_of(photo(seed).transpose(Image.Transpose.FLIP_LEFT_RIGHT)) for seed in range(20)]
    everything = hashes + turned
    assert min((a ^ b).bit_count() for i, a in enumerate(everything) for b in everything[:i]) > SAME


def one_by_one(hashes, pixels, bits):
    """What `find_near_duplicates` says, by comparing each with each."""
    kept, gone = [], {}
    for number in sorted(range(len(hashes)), key=lambda n: (-pixels[n], n)):
        near = min((((hashes[k] ^ hashes[number]).bit_count(), place) for place, k in enumerate(kept)), default=(99, 0))
        if near[0] <= bits:
            gone[number] = (kept[near[1]], near[0])
        else:
            kept.append(number)
    return gone


def clustered(seed: int, count: int, centres: int, flips: int) -> list[int]:
    draw = np.random.default_rng(seed)
    middle = [int(value) for value in draw.integers(0, 2**64, centres, dtype=np.uint64)]
    hashes = []
    for _ in range(count):
        value = middle[draw.integers(centres)]
        for place in draw.integers(0, 64, draw.integers(flips + 1)):
            value ^= 1 << int(place)
        hashes.append(value)
    return hashes


@given(st.integers(0, 10_000), st.integers(0, MAX_BITS), st.sampled_from([1, 5, 60]))
def test_near_ones_are_those_of_a_full_comparison(seed, bits, centres):
    hashes = clustered(seed, 60, centres, 12)
    pixels = np.random.default_rng(seed).integers(1, 4, 60).tolist()
    assert find_near_duplicates(hashes, pixels, bits) == one_by_one(hashes, pixels, bits)


def test_frames_of_one_film_are_scanned_with_the_same_result():
    hashes = clustered(1, 1500, 1, 14)
    assert find_near_duplicates(hashes, [1] * 1500, 6) == one_by_one(hashes, [1] * 1500, 6)


def test_the_largest_is_kept_and_of_equal_ones_the_first():
    assert find_near_duplicates([0, 1, 3, 1 << 40], [10, 20, 20, 5], 2) == {2: (1, 1), 0: (1, 1), 3: (1, 2)}


def look(**changes) -> ImageStats:
    return ImageStats(**{"width": 640, "height": 480, "contrast": 40.0, "sharpness": 0.1, "phash": 0, **changes})


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"width": 255}, "too_small"),
        ({"height": 255}, "too_small"),
        ({"width": 1441}, "odd_shape"),
        ({"contrast": 7.9}, "uniform"),
        ({"sharpness": 0.0099}, "blurred"),
    ],
)
def test_each_threshold_has_its_reason(changes, reason):
    found = find_rejection(look(**changes), FilterCriteria())
    assert found is not None
    assert found[0] == reason
    assert find_rejection(look(), FilterCriteria()) is None


def test_of_equally_large_copies_the_one_with_a_licence_stays():
    plain = {"kind": "image", "content_sha256": "0" * 64, "name": "a.jpg"}
    rows = [
        ImageRow(scene_id=name, uri=f"/{name}.jpg", licence=licence, **plain)
        for name, licence in (("unknown", ""), ("free", "CC0-1.0"), ("smaller", "CC0-1.0"))
    ]
    looks = {"unknown": look(), "free": look(), "smaller": look(width=639)}
    kept = [row.scene_id for row in filter_rows(rows, looks, FilterCriteria()) if not row.rejected]
    assert kept == ["free"]


def test_what_was_fetched_and_rejected_is_printed_by_its_address(capsys):
    row = ImageRow(
        scene_id="a", kind="image", uri=f"/pictures/{'0' * 64}.jpg", url="https://a.example/b.jpg", rejected="blurred"
    )
    _print_manifest(Manifest((row,), {}), "m.parquet")
    assert "image https://a.example/b.jpg: blurred" in capsys.readouterr().out


def test_sharpness_falls_with_blur_and_not_with_light():
    picture = photo(1, (1024, 768))
    sharp = [measure_image(np.asarray(picture.filter(ImageFilter.GaussianBlur(r)))).sharpness for r in (0, 1, 2, 4, 8)]
    assert sharp == sorted(sharp, reverse=True)
    dark = measure_image(np.asarray(picture.point(lambda level: level // 2))).sharpness
    assert dark == pytest.approx(sharp[0], rel=0.1)


def test_a_picture_of_one_colour_or_one_pixel_can_be_looked_at():
    for size in ((1, 1), (1, 900), (300, 300)):
        seen = measure_image(np.full((*size, 3), 77, np.uint8))
        assert (seen.contrast, seen.sharpness) == (0.0, 0.0)


@pytest.mark.heavy
@pytest.mark.shared
def test_real_table_tops_pass_and_their_blurred_copies_do_not(shared_dir):
    for path in sorted((shared_dir / "captures").glob("*/color.png")):
        picture = Image.open(path).convert("RGB")
        assert find_rejection(measure_image(np.asarray(picture)), FilterCriteria()) is None, path
        blurred = picture.filter(ImageFilter.GaussianBlur(picture.width / 160))
        assert find_rejection(measure_image(np.asarray(blurred)), FilterCriteria()) is not None, path
