"""The funnel of a dataset."""

import pytest

from tableverse_factory.viz.funnel import SceneLoss, compute_funnel

FROM_LAYOUT = ["rectify", "settle", "curate", "export"]


def test_the_funnel_ends_with_the_done_scenes_and_accounts_for_every_loss():
    losses = [
        SceneLoss("settle", "dropped", "x", 3),
        SceneLoss("settle", "failed", "y", 2),
        SceneLoss("manifest", "dropped", "z", 1),
    ]
    steps = compute_funnel(10, losses, {"layout"})
    assert [(s.stage, s.left, s.count_lost("dropped"), s.count_lost("failed")) for s in steps] == [
        ("manifest", 9, 1, 0),
        ("read_layout", 9, 0, 0),
        ("rectify", 9, 0, 0),
        ("settle", 4, 3, 2),
        ("curate", 4, 0, 0),
        ("export", 4, 0, 0),
    ]


@pytest.mark.parametrize(
    ("kinds", "own"),
    [
        ({"image"}, ["observe", "perceive", "place"]),
        ({"image", "capture"}, ["observe", "perceive", "place"]),
        ({"cousin"}, ["derive_cousin"]),
        ({"capture", "layout"}, ["observe", "perceive", "place", "read_layout"]),
    ],
)
def test_the_funnel_has_the_stages_of_the_kinds_that_entered(kinds, own):
    assert [step.stage for step in compute_funnel(2, [], kinds)] == [*own, *FROM_LAYOUT]
