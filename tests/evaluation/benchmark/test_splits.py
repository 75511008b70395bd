"""Splits: no picture and no held-out thing of the tests is trained on."""

import pytest

from tableverse_factory.evaluation.benchmark.splits import (
    HELD_OUT_SHARE,
    find_noun,
    find_task_split,
    is_held_out,
    list_split_tasks,
    select_known_phrases,
)
from tableverse_factory.stages.curate.lexicon import KINDS


def test_held_out_nouns_are_some_and_stay_so():
    nouns = sorted({find_noun({"relabel_name": word, "label": ""}) for words in KINDS.values() for word in words})
    held_out = {noun for noun in nouns if is_held_out(noun)}
    assert len(held_out) / len(nouns) == pytest.approx(HELD_OUT_SHARE, abs=0.06)
    assert {"dish", "jar", "orange", "phone"} <= held_out, "as the docs and frozen benchmarks say"
    assert held_out.isdisjoint({"apple", "cup", "can", "basin", "spoon", "block"})


def test_names_of_one_thing_have_one_noun():
    assert {find_noun({"relabel_name": name, "label": ""}) for name in ("red mug", "cup of tea", "teacup")} == {"cup"}
    assert {find_noun({"relabel_name": None, "label": name}) for name in ("plate", "saucers", "dish")} == {"dish"}


def test_a_held_out_thing_is_never_trained_on():
    for split in ("train", "validation", "test"):
        row = {"split": split, "scene_id": "s"}
        assert find_task_split(row, ("cup", "box")) == split
        for nouns in (("phone", "box"), ("cup", "dish")):
            assert find_task_split(row, nouns) == ("unseen_kinds" if split == "test" else None)


@pytest.mark.heavy
def test_only_solved_tasks_are_listed_each_in_the_split_of_its_picture(dataset):
    assert list_split_tasks(dataset) == {
        ("s-0", "task_000"): "test",
        ("s-1", "task_000"): "train",
        ("s-2", "task_000"): "test",
    }


@pytest.mark.heavy
def test_scenes_of_splits_are_disjoint(benchmark):
    scenes = {split: {e.scene_id for e in benchmark.episodes if e.split == split} for split in ("train", "test")}
    assert scenes["train"]
    assert scenes["test"]
    assert scenes["train"].isdisjoint(scenes["test"])


def test_phrases_with_a_held_out_noun_are_not_known():
    known = (
        "the orange tea box",
        "the mug nearest to the camera",
        "the second book from the left",
        "the fork in the cup",
    )
    unknown = (
        "the plate",
        "the orange",
        "the mug next to the smallest plate",
        "the lime on the plate nearest to the camera",
    )
    assert select_known_phrases([*known, *unknown]) == known
