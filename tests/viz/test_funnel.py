"""The funnel of a dataset."""

from tableverse_factory.viz.funnel import SceneLoss, compute_funnel


def test_the_funnel_ends_with_the_done_scenes_and_accounts_for_every_loss():
    losses = [
        SceneLoss("b", "dropped", "x", 3),
        SceneLoss("b", "failed", "y", 2),
        SceneLoss("manifest", "dropped", "z", 1),
    ]
    steps = compute_funnel(10, losses, ("a", "b", "c"))
    assert [(s.stage, s.left, s.count_lost("dropped"), s.count_lost("failed")) for s in steps] == [
        ("manifest", 9, 1, 0),
        ("a", 9, 0, 0),
        ("b", 4, 3, 2),
        ("c", 4, 0, 0),
    ]
