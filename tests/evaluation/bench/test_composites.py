"""The composites bench: what it counts, and that its picture is one."""

from pathlib import Path

import pytest
from PIL import Image

from schemas.config import Config
from tableverse_factory.evaluation.bench import composites


def test_a_few_marbles_in_a_bowl_are_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(composites, "VESSELS", {"bowl": composites.VESSELS["bowl"]})
    monkeypatch.setattr(composites, "CONTENTS", {name: composites.CONTENTS[name] for name in ("lemon", "marble")})
    done: list[None] = []
    one, four = composites.bench_composites(0, Config(), tmp_path, lambda: done.append(None))
    assert len(done) == composites.cases() == 2
    assert (one.asked, one.inside, one.kept, one.at_rest) == (1, 1, 1, True)
    assert (four.asked, four.inside, four.kept, four.at_rest) == (4, 4, 4, True)


def test_the_picture_shows_each_twice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(composites, "SHOWN", (("mug", "marble", 2),))
    composites.write_picture(tmp_path / "composite.png", 0, Config(), tmp_path)
    with Image.open(tmp_path / "composite.png") as picture:
        assert picture.size == (264, 2 * 208 + 6)
