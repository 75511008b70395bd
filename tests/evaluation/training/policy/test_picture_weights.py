"""Weights of the package for the policy on pictures: they mark what is named."""

import numpy as np
import pytest

from tableverse_factory.evaluation.training.policy.synthetic_views import take_synthetic_view
from tableverse_factory.evaluation.training.policy.views import join_views

torch = pytest.importorskip("torch", reason="the extra `models` is not installed")
from tableverse_factory.evaluation.training.policy.picture_lesson import PictureTensors  # noqa: E402
from tableverse_factory.evaluation.training.policy.picture_policy import PicturePolicy, fill_behind  # noqa: E402
from tableverse_factory.evaluation.training.policy.sight import describe_points  # noqa: E402

pytestmark = pytest.mark.heavy
NEVER_DRAWN = 7_000_000  # numbers of tables from which on no training has seen them


@pytest.mark.slow  # how good weights are; test_baselines.py runs them
def test_they_mark_what_is_named_on_tables_that_no_training_saw() -> None:
    views = [(take_synthetic_view(NEVER_DRAWN + k, "panda"), True) for k in range(4)]
    shown = PictureTensors(join_views("panda", views), "cpu")
    network = PicturePolicy()._network.sight
    overlaps = []
    for view in range(len(views)):
        own = torch.tensor([view])
        told = describe_points(shown.compute_rays(own), shown.read_depth(own, False), shown.base_turn[own])
        for name in range(int((shown.words[view, :, 0, 0] > 0).sum())):
            phrase = shown.words[view, name, 0][None].long()
            if not phrase.any() or (wanted := shown.objects[view] == name + 1).sum() < 60:
                continue
            words = shown.wordings.compose(phrase, phrase)
            with torch.inference_mode():
                marked = network(shown.colors[own].float() / 255, told, words)[0, :, 0].flatten() > 0
            overlaps.append(float((marked & wanted).sum() / (marked | wanted).sum()))
    assert len(overlaps) > 10
    assert np.mean(overlaps) > 0.5


def test_things_are_taken_to_be_solid_behind_what_is_seen() -> None:
    seen = torch.tensor([[0.0, 0.0, 0.05], [0.1, 0.0, 0.002]])
    along = torch.tensor([[0.6, 0.0, -0.8], [0.6, 0.0, -0.8]])
    filled = fill_behind(seen, along)
    assert {tuple(row) for row in seen.tolist()} <= {tuple(row) for row in filled.tolist()}
    assert len(filled) > 2
    assert filled[:, 2].min() > 0.0
