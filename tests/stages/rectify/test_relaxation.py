"""The joint least motion is bounded: beyond the bound things go straight outward, which is exact, and it is told."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import isotonic_regression

from schemas.config import Config, RectifyConfig
from schemas.geometry import Pose
from schemas.objects import PlacedObject, PlacedObjects, Table
from schemas.outcome import Done
from tableverse_factory.core.seeding import make_rng
from tableverse_factory.models.services import Services
from tableverse_factory.stages.rectify import relaxation
from tableverse_factory.stages.rectify.joint import order_upward, rectify_jointly
from tableverse_factory.stages.rectify.rectify import rectify
from tableverse_factory.stages.rectify.support import SupportRelation
from tests.helpers.convex_layouts import box, offsets, part, placed, smallest_gap

CONFIG = RectifyConfig(method="joint")


def heap(count: int) -> list[PlacedObject]:
    """Boxes of all sizes within a centimetre or two of one place."""
    rng = np.random.default_rng(0)
    return [
        placed(f"obj_{k:03d}", box(*rng.uniform(0.02, 0.1, 3)), (*rng.normal(0, 0.01, 2), 0.03), rng.uniform(0, 6))
        for k in range(count)
    ]


@pytest.mark.heavy
@pytest.mark.parametrize(("count", "method"), [(10, "joint"), pytest.param(80, "radial", marks=pytest.mark.slow)])
def test_many_things_in_one_place_end_free_and_it_is_told_how(count: int, method: str) -> None:
    result = rectify_jointly([part(item) for item in heap(count)], CONFIG)
    assert result.method == method
    assert smallest_gap(result.parts) >= CONFIG.clearance_m - 2e-6
    assert min(moved.lowest_now_m for moved in result.parts) > -1e-9


def test_beyond_the_work_allowed_things_go_straight_outward(monkeypatch: pytest.MonkeyPatch) -> None:
    pair = [
        part(placed("a", box(0.1, 0.1, 0.1), (0, 0, 0.05))),
        part(placed("b", box(0.1, 0.1, 0.1), (0.08, 0.02, 0.05))),
    ]
    least = rectify_jointly(pair, CONFIG)
    monkeypatch.setattr(relaxation, "MAX_WORK", 1.0)
    outward = rectify_jointly(pair, CONFIG)
    assert (least.method, outward.method) == ("joint", "radial")
    assert smallest_gap(outward.parts) >= CONFIG.clearance_m - 2e-6
    assert np.abs(offsets(outward)[0]).max() == 0.0
    assert offsets(outward)[1, 1] / offsets(outward)[1, 0] == pytest.approx(0.25)


def test_a_heap_beyond_the_work_allowed_does_not_keep_the_rest_from_its_least_motion(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pair = [placed(f"pair_{k}", box(0.1, 0.1, 0.1), (1.0 + 0.08 * k, 0, 0.05)) for k in (0, 1)]
    alone = rectify_jointly([part(item) for item in pair], CONFIG)
    monkeypatch.setattr(relaxation, "MAX_WORK", 2e5)
    result = rectify_jointly([part(item) for item in [*heap(12), *pair]], CONFIG)
    assert (alone.method, result.method) == ("joint", "partly radial")
    assert np.abs(offsets(result)[12:] - offsets(alone)).max() < 1e-9
    assert smallest_gap(result.parts) >= CONFIG.clearance_m - 2e-6


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("bound", "most"), [pytest.param("MAX_WORK", 1.5e7, marks=pytest.mark.slow), ("MAX_WAYS_OUT", 130)]
)
def test_the_work_of_a_layout_is_bounded_whatever_its_clusters(
    bound: str, most: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The bound allows one heap and a pair: the pair and one heap go the least way, the other heap straight outward."""
    heaps = [
        replace(
            item, object_id=f"{name}_{item.object_id}", pose=replace(item.pose, position=item.pose.position + aside)
        )
        for name, aside in (("a", np.zeros(3)), ("b", np.array([1.0, 0.0, 0.0])))
        for item in heap(6)
    ]
    pair = [placed(f"z_{k}", box(0.1, 0.1, 0.1), (0.5 + 0.08 * k, 0.5, 0.05)) for k in (0, 1)]
    parts = [part(item) for item in [*heaps, *pair]]
    free = rectify_jointly(parts, CONFIG)
    monkeypatch.setattr(relaxation, bound, most)
    bounded = rectify_jointly(parts, CONFIG)
    same = np.abs(offsets(bounded) - offsets(free)).max(axis=1) < 1e-9
    assert (free.method, bounded.method) == ("joint", "partly radial")
    assert same[:6].all()
    assert not same[6:12].all()
    assert same[12:].all()
    assert smallest_gap(bounded.parts) >= CONFIG.clearance_m - 2e-6


def test_clusters_that_would_meet_on_their_ways_are_one() -> None:
    """Each pair would part by half its overlap, and the inner ones into one another."""
    at = [-0.135, -0.053, 0.053, 0.135]
    result = rectify_jointly(
        [part(placed(f"obj_{k}", box(0.1, 0.1, 0.1), (x, 0, 0.05))) for k, x in enumerate(at)], CONFIG
    )
    ahead = (0.1 + CONFIG.clearance_m) * np.arange(4)
    least = isotonic_regression(at - ahead).x + ahead - at
    assert result.method == "joint"
    assert offsets(result)[:, 0] == pytest.approx(least, abs=2e-5)


@pytest.mark.parametrize("pitch", [0.06, 0.05, 0.03])
def test_in_a_row_of_deep_overlaps_nothing_moves_more_than_along_the_row(pitch: float) -> None:
    at = pitch * (np.arange(5) - 2)
    result = rectify_jointly(
        [part(placed(f"obj_{k}", box(0.1, 0.1, 0.1), (x, 0, 0.05))) for k, x in enumerate(at)], CONFIG
    )
    ahead = (0.1 + CONFIG.clearance_m) * np.arange(5)
    along = isotonic_regression(at - ahead).x + ahead - at
    assert (offsets(result) ** 2).sum() <= (along**2).sum() + 1e-6
    assert smallest_gap(result.parts) >= CONFIG.clearance_m - 2e-6


def test_what_leans_comes_back_from_where_noise_took_it() -> None:
    """18 mm away from what it leans on, twice of what counts as contact."""
    prop = placed("prop", box(0.1, 0.2, 0.1), (0, 0, 0.05))
    middle, half = np.array([0.1225 + 0.036, 0.0, 0.0637]), np.radians(15.0)
    leaning = replace(
        placed("board", box(0.24, 0.1, 0.008), (0, 0, 0)),
        pose=Pose(middle, np.array([np.cos(half), 0, np.sin(half), 0])),
    )
    before = [part(leaning), part(prop)]
    assert 0.016 < smallest_gap(before) < 0.02
    assert smallest_gap(rectify_jointly(before, CONFIG).parts) < 0.002


def test_who_carries_whom_in_a_heap_is_put_in_order_in_bounded_time() -> None:
    """A circle, and a carrier that comes last in the file."""
    parts = [part(placed(name, box(0.1, 0.1, 0.1), (0, 0, 0.05))) for name in "abcde"]
    support = SupportRelation(frozenset({(0, 4), (1, 2), (2, 3), (3, 1)}), (False, False, False, False, True))
    assert order_upward(parts, support) == [4, 0, 1, 3, 2]


@pytest.mark.parametrize(
    ("method", "work", "told"), [("joint", 1e9, "joint"), ("joint", 1.0, "radial"), ("lccr", 1.0, "lccr")]
)
def test_the_layout_tells_what_it_took(
    method: str, work: float, told: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(relaxation, "MAX_WORK", work)
    table = Table(np.zeros(2), np.ones(2), 0.0, (200, 200, 200), 0.0)
    pair = (placed("a", box(0.1, 0.1, 0.1), (0, 0, 0.05)), placed("b", box(0.1, 0.1, 0.1), (0.08, 0.02, 0.05)))
    config = Config.model_validate({"rectify": {"method": method}})
    outcome = rectify(
        PlacedObjects("scene", table, pair, None), config, make_rng(0, "scene", "rectify"), Services(tmp_path)
    )
    assert isinstance(outcome, Done)
    assert outcome.value.method == told
