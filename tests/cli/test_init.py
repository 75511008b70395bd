"""`tableverse init`: the file is the defaults, says everything about every key, and never overwrites anything."""

import re

import pytest

from schemas.config import Config
from tableverse_factory.core.config import format_commented_yaml, list_keys, load_config


def test_what_is_written_is_the_defaults_and_build_takes_it(tableverse, tmp_path):
    answer = tableverse("init", tmp_path / "kitchen")
    assert answer.code == 0
    assert load_config(tmp_path / "kitchen" / "config.yaml") == Config()
    taken = tableverse("build", "nowhere.parquet", tmp_path / "out", "--config", tmp_path / "kitchen" / "config.yaml")
    assert "nowhere.parquet" in taken.err, "the configuration was read before the manifest was missed"


def test_every_key_says_what_it_means_what_it_allows_and_its_default():
    text = format_commented_yaml()
    for key, field in list_keys().items():
        assert field.get("description"), f"{key} has no docstring in schemas/config.py"
        line = next(line for line in text.splitlines() if line.startswith(f"  {key.partition('.')[2]}: "))
        assert "; default " in line
    units = {"_m": "[m]", "_s": "[s]", "_kg": "[kg]", "_mb": "[MB]", "_bytes": "[bytes]"}
    for key, field in list_keys().items():
        for ending, unit in units.items():
            if key.endswith(ending) and not key.endswith("trajectories.deadline_s"):
                assert unit in field["description"], f"{key} does not say its unit"


def test_nothing_is_overwritten(tableverse, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert tableverse("init").code == 0
    (tmp_path / "config.yaml").write_text("run: {seed: 7}\n")
    again = tableverse("init")
    assert again.code == 1
    assert re.fullmatch(r"error: config\.yaml is there already[^\n]+\nhelp: [^\n]+\n", again.err)
    assert (tmp_path / "config.yaml").read_text() == "run: {seed: 7}\n"
    (tmp_path / "config.yaml").unlink()
    assert tableverse("init").code == 1, "the other file may have been edited"
    assert not (tmp_path / "config.yaml").exists()


@pytest.mark.slow  # `make demo` makes captures too
@pytest.mark.heavy
def test_captures_are_made_and_found_in_it(tableverse, tmp_path, monkeypatch):
    """What `init` says comes next works in the folder that it made."""
    monkeypatch.chdir(tmp_path)
    assert tableverse("init", "here").code == 0
    monkeypatch.chdir(tmp_path / "here")
    assert tableverse("synth", "captures", "--scenes", "1").code == 0
    found = tableverse("manifest", "captures", "--out", "images.parquet")
    assert found.code == 0
    assert "1 row in images.parquet" in found.out


def test_a_licence_is_asked_for_from_the_beginning(tableverse, tmp_path):
    told = tableverse("init", tmp_path / "here").out
    assert "tableverse view out" in told
    assert "licence" in (tmp_path / "here" / "CAPTURES.md").read_text()
