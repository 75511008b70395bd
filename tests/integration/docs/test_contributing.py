"""The examples of CONTRIBUTING.md, put into a copy of the code, build a dataset as the page says."""

import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import trimesh
import yaml

from tests.helpers.paths import ROOT

PAGE = ROOT / "CONTRIBUTING.md"
CODE = ("schemas", "tableverse_factory", "workers")
ALSO = ("pyproject.toml",)

BLOCK = re.compile(r"^```(python|diff)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def blocks(language: str) -> list[str]:
    return [text for kind, text in BLOCK.findall(PAGE.read_text()) if kind == language]


def write_file(home: Path, block: str) -> Path:
    """A block of Python whose first line names its file."""
    head, _, text = block.partition("\n")
    path = home / head.removeprefix("# ")
    assert path.suffix == ".py", head
    assert not path.exists(), f"{path} is there already: the example adds nothing"
    path.write_text(text)
    return path


def change_file(home: Path, block: str) -> Path:
    """A block of changes: `--- FILE`, then parts that begin with `@@`; what they take as there must be there once."""
    head, *parts = re.split(r"^@@\n", block, flags=re.MULTILINE)
    path = home / head.removeprefix("--- ").strip()
    text = path.read_text()
    for part in parts:
        lines = part.splitlines()
        assert {line[:1] for line in lines} <= {" ", "-", "+"}, part
        before = "".join(f"{line[1:]}\n" for line in lines if line[0] in " -")
        after = "".join(f"{line[1:]}\n" for line in lines if line[0] in " +")
        assert text.count(before) == 1, f"{path.name} holds this {text.count(before)} times:\n{before}"
        text = text.replace(before, after)
    path.write_text(text)
    return path


def write_layouts(folder: Path) -> None:
    """A scene that stands fast, and one with a thing that topples where the table is tipped by ten degrees."""
    folder.mkdir()
    trimesh.creation.box((0.08, 0.08, 0.06)).export(folder / "block.obj")
    trimesh.creation.box((0.02, 0.02, 0.2)).export(folder / "tower.obj")
    for name, label, height in (("block", "wooden block", 0.06), ("tower", "wooden tower", 0.2)):
        pose = {"position": [0, 0, height / 2], "quaternion_wxyz": [1, 0, 0, 0]}
        entry = {"id": "obj_000", "label": label, "mesh": f"{name}.obj", "pose": pose}
        (folder / f"{name}.json").write_text(json.dumps({"scene_id": name, "objects": [entry]}))


@pytest.fixture(scope="module")
def home(tmp_path_factory) -> Path:
    """A copy of the code with every example of the page in it."""
    copy = tmp_path_factory.mktemp("house")
    for name in CODE:
        shutil.copytree(ROOT / name, copy / name)
    for name in ALSO:
        shutil.copy(ROOT / name, copy)
    for block in blocks("python"):
        write_file(copy, block)
    for block in blocks("diff"):
        change_file(copy, block)
    return copy


def in_copy(home: Path, *command: object) -> str:
    """What Python prints with these arguments and the code of the copy."""
    environment = {**os.environ, "PYTHONPATH": str(home), "XDG_CACHE_HOME": str(home / "cache")}
    done = subprocess.run(
        [sys.executable, *map(str, command)], cwd=home, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def tableverse(home: Path, *arguments: object) -> str:
    return in_copy(home, "-c", "from tableverse_factory.cli.main import main; main()", *arguments)


@pytest.mark.slow  # builds of a page for contributors
def test_the_examples_build_what_the_page_says(home):
    write_layouts(home / "layouts")
    tableverse(home, "manifest", "layouts", "--out", "m.parquet")
    settings = ("curate.judge=weighed", "curate.weighed_kg={wooden block: 0.123}", "tilt.angle_deg=10")
    words = ("build", "m.parquet", "out", "--executor", "local")  # Ray: ten seconds more; tests/integration/ray has it
    tableverse(home, *words, *(word for setting in settings for word in ("--set", setting)))

    printed = tableverse(home, "query", "out", "--columns", "uri,status,stage,reason,judge,slid_m", "--format", "json")
    rows = {Path(row["uri"]).stem: row for row in json.loads(printed)}
    assert (rows["block"]["status"], rows["block"]["judge"]) == ("done", "weighed")
    assert (rows["tower"]["status"], rows["tower"]["stage"], rows["tower"]["reason"]) == ("dropped", "tilt", "slid")
    assert 0.0 <= rows["block"]["slid_m"] < 0.01
    assert tableverse(home, "heaviest", "out").startswith("0.123 kg  wooden block")


def test_the_examples_keep_the_rules_of_the_house(home):
    changed = [block.split()[1] for block in blocks("python") + blocks("diff")]
    sources = [name for name in changed if name.endswith(".py")]
    in_copy(home, "-m", "ruff", "check", "--no-cache", *sources)
    in_copy(home, "-m", "ruff", "format", "--no-cache", "--check", *sources)


def test_there_are_examples():
    assert len(blocks("python")) >= 3
    assert len(blocks("diff")) >= 6


def test_every_defence_has_its_test():
    text = (ROOT / "SECURITY.md").read_text()
    named = re.findall(r"`(tests/[\w/]+\.py)(?:::(\w+))?`", text)
    assert len(named) > 10
    for path, test in named:
        source = (ROOT / path).read_text()
        assert f"\ndef {test}(" in source or not test, f"{path} has no {test}"


@pytest.mark.parametrize("page", ["CONTRIBUTING.md", "SECURITY.md", "CODE_OF_CONDUCT.md"])
def test_links_lead_somewhere(page):
    links = re.findall(r"\]\(([^)#:]+)\)", (ROOT / page).read_text())
    assert not [link for link in links if not (ROOT / link).exists()]


def test_forms_ask_for_what_is_there_and_ci_runs_verbs_that_are_there():
    forms = {path.stem: yaml.safe_load(path.read_text()) for path in (ROOT / ".github/ISSUE_TEMPLATE").glob("*.yml")}
    for name in ("bug", "wrong-scene", "feature"):
        assert {"name", "description", "body"} <= forms[name].keys()
        assert len({field["id"] for field in forms[name]["body"]}) == len(forms[name]["body"])
    jobs = yaml.safe_load((ROOT / ".github/workflows/ci.yml").read_text())["jobs"]
    commands = [step.get("run", "") for job in jobs.values() for step in job["steps"]]
    verbs = [verb for command in commands for verb in re.findall(r"\bmake (\w+)$", command)]
    makefile = (ROOT / "Makefile").read_text()
    assert {"check", "test"} <= set(verbs)
    assert not [verb for verb in verbs if f"\n{verb}:" not in makefile]


def test_the_version_stands_in_one_place():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert project["dynamic"] == ["version"]
    assert not {"version", "date-released"} & (project.keys() | citation.keys())
    assert {"cff-version", "message", "title", "authors"} <= citation.keys()
