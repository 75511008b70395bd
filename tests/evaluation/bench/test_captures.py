"""Benchmarks of captures take a folder of captures, or one of them."""

from pathlib import Path

import pytest

from schemas.manifest import SceneKind
from tableverse_factory.core.errors import InputError
from tableverse_factory.evaluation.bench.captures import list_captures, make_row
from tableverse_factory.sources.synthetic.synthesize import synthesize_captures

NEEDED = (("seg.png", "masks.png"), ("color.png",))


def test_a_capture_is_itself_or_stands_in_the_folder(tmp_path, monkeypatch) -> None:
    for name, files in {"b": ["color.png", "masks.png"], "a": ["color.png", "seg.png"], "none": ["color.png"]}.items():
        (tmp_path / name).mkdir()
        for file in files:
            (tmp_path / name / file).touch()
    (tmp_path / "masks.png").touch()
    assert list_captures(tmp_path, *NEEDED) == [tmp_path / "a", tmp_path / "b"]
    assert list_captures(tmp_path / "a", *NEEDED) == [tmp_path / "a"]
    assert list_captures(tmp_path / "none", *NEEDED) == []
    monkeypatch.chdir(tmp_path / "b")
    assert [capture.name for capture in list_captures(Path(), *NEEDED)] == ["b"]


@pytest.mark.heavy
@pytest.mark.parametrize(
    "name", ["picture", *(pytest.param(name, marks=pytest.mark.slow) for name in ("perception", "placement", "twin"))]
)
def test_a_single_capture_is_measured(tmp_path, run, name) -> None:
    (capture,) = synthesize_captures(tmp_path, 1, seed=38)
    code, said, errors = run("bench", name, capture)
    assert code == 0, errors
    assert (f"\n{capture.name} " if name != "placement" else "not placed:") in said


def test_a_name_that_is_not_utf_8_is_said() -> None:
    with pytest.raises(InputError, match="name is not UTF-8: rename it"):
        make_row(SceneKind.CAPTURE, Path("bad\udcff"), "bad")
