"""The dataset card counts its scenes by what their metres and their cameras come from."""

from tableverse_factory.dataset.card import make_dataset_card
from tests.helpers.gallery_dataset import scene_members, write_dataset

PLACED = {"seed": 0, "fingerprint": "f" * 64, "config": {"export": {"poses": "placed"}}}


def test_the_card_counts_scales_and_cameras(tmp_path):
    names = ("photo", "one", "two")
    out = write_dataset(tmp_path / "out", {name: scene_members(name, photographed=False) for name in names}, [])
    card = make_dataset_card(out, {"seed": 0, "fingerprint": "f" * 64}, [0])
    assert "settled, and certified" in card
    assert "may collide and move" in make_dataset_card(out, PLACED, [0])
    lines = card[card.index("## Scale") :].splitlines()[2:6]
    assert lines == [
        "| metres | camera | done scenes |",
        "| --- | --- | --- |",
        "| given | – | 2 |",
        "| measured | exif | 1 |",
    ]
