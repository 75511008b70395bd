"""Whoever types what a page says gets what it says: the commands of README.md and docs/ are run, in their order.

Not run is what `CANNOT` names, each with its reason; of it the `tableverse` commands are read by the real command line,
as are all of them. Pages beyond `SHORT` are run where slow tests are; otherwise they are only read.
"""

import ast
import importlib
import importlib.util
import re
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from tests.helpers.command_lines import check_command, check_mention
from tests.helpers.docs_pages import PAGES, SHELL, Block, Command, blocks, commands, mentioned
from tests.helpers.docs_workspace import Room
from tests.helpers.paths import ROOT


def needs(module: str, pattern: str, reason: str) -> tuple[tuple[str, str], ...]:
    """What cannot run where an optional module is missing: nothing where it is installed."""
    return () if importlib.util.find_spec(module) else ((pattern, reason),)


CANNOT = (
    (r"make |git |pip |source ", "sets up the environment that this test runs in"),
    (r"sbatch |ray |RAY_AUTH", "needs a cluster, containers or an account"),
    (r"export AWS_", "would point all that follows at a store that is not there"),
    (r".*\bs3://", "needs an object store; tests/integration/s3 has one"),
    (r".*\b(hf|https?)://|tableverse publish ", "needs a server; tests/delivery has one"),
    (r"tableverse submit ", "needs a Ray cluster; tests/integration/ray has one"),
    (r"tableverse view ", "serves until it is stopped; tests/viz does that"),
    (r"xdg-open ", "opens a window"),
    (r".*judge=gemini", "needs a key for a model"),
    (r".*--max-usd", "needs a model that is paid"),
    (r"tableverse (bench|train) ", "takes minutes"),
    (r"tableverse benchmark .*state\.jsonl", "needs benchmark.json of an earlier page"),
    (r"tableverse benchmark .*pictures\.jsonl", "needs a policy that was trained"),
    (r".*--config recipes/", "needs weights; tests/integration/builds has small ones"),
    (r"tableverse estimate ", "needs fifty scenes that were built"),
    (r"tableverse evaluate (collisions|tables|layout out)", "needs other methods' scenes; tests/evaluation has some"),
    (r"tableverse textures index ", "needs textures that somebody photographed"),
    *needs("pxr", r".* --format usd", "usd-core is an extra; tests/delivery/formats has tests for it"),
)
"""What a test cannot run, and why. A `tableverse` command among it is still read by the real command line."""

PYTHON_CANNOT = (
    (r"from lerobot\.", "lerobot brings a gigabyte"),
    (r"mujoco_warp|WarpBatch", "mujoco-warp compiles for minutes; tests/delivery/learning has a test for it"),
    (r"from dm_control", "dm_control wants a MuJoCo of its own; tests/delivery/learning has a test for it"),
    (r"robosuite", "robosuite wants an older MuJoCo; tests/delivery/learning has a test for it"),
    (r"mani_skill", "ManiSkill brings torch and SAPIEN; tests/delivery/learning has a test for it"),
    (r"import pybullet", "pybullet compiles for minutes; tests/delivery/formats has a test for it"),
    (r"serve_forever|serve_policy", "serves until it is stopped"),
    *needs("datasets", r"from datasets", "datasets is no dependency; tests/delivery/formats has a test for it"),
    *needs("webdataset", r"import webdataset", "webdataset is no dependency; tests/delivery/formats has a test for it"),
    (r"open_library", "needs textures that somebody photographed"),
    (r"(hf|s3|https?)://", "needs a server"),
    (r"\btargets\b", "a fragment: the reader has the targets"),
)
"""The same for Python."""

OURS = ("tableverse_factory", "workers", "schemas")

TESTED_BY_ITSELF = ("cookbook.md",)
"""Pages whose Python another test runs, on data of its own; their commands are run here."""

SHORT = ("README.md",)
"""Pages that `make test` runs; the commands of all others it only reads, and `make test-all` runs them."""


def why_not(text: str) -> str | None:
    return next((reason for pattern, reason in CANNOT if re.match(pattern, text, re.DOTALL)), None)


def chapters(page: Path) -> list[list[Command | Block]]:
    """Commands and Python in the order of the page; each chapter begins afresh."""
    all_found: list[list[Command | Block]] = [[]]
    for block in blocks(page):
        if block.afresh:
            all_found.append([])
        found = all_found[-1]
        if block.language in SHELL:
            found += commands(block)
        elif block.language == "python" and page.name not in TESTED_BY_ITSELF:
            found.append(block)
    return [found for found in all_found if found]


@pytest.fixture(scope="session")
def prepared(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("documentation")


def pages() -> list[Any]:
    return [
        pytest.param(page, id=page.stem, marks=[] if page.name in SHORT else [pytest.mark.slow])
        for page in PAGES
        if chapters(page)
    ]


@pytest.mark.parametrize("page", pages())
def test_every_command_does_what_the_page_says(page: Path, prepared: Path, monkeypatch) -> None:
    for chapter in chapters(page):
        typed = [step for step in chapter if isinstance(step, Command)]
        monkeypatch.chdir(prepared)
        room = Room(prepared / "prepared", prepared / "reading", typed)
        read(page, chapter, room)


def read(page: Path, chapter: list[Command | Block], room: Room) -> None:
    names: dict[str, object] = {"__name__": "__page__"}
    for step in chapter:
        if isinstance(step, Block):
            room.enter()
            run_python(page, step, room, names)
        elif why_not(step.text) is None:
            answer = room.type(step)
            where = f"{page.relative_to(ROOT)}:{step.line}: {step.text}\n{answer.out[-1500:]}{answer.err[-1500:]}"
            check_answer(step, answer.code, answer.err, where)


def check_answer(step: Command, code: int, err: str, where: str) -> None:
    """A transcript that shows an error must get this error; everything else must succeed."""
    shown = " ".join(line.strip() for line in step.answer)
    if shown.startswith("error:"):
        told = " ".join(err.split())
        missing = [piece for piece in map(str.strip, shown.split("…")) if piece not in told]
        assert code == 1, where
        assert not missing, f"not said: {missing}\n{where}"
    else:
        assert code == 0, where


def run_python(page: Path, block: Block, room: Room, names: dict[str, object]) -> None:
    if any(re.search(pattern, block.text) for pattern, _ in PYTHON_CANNOT):
        compile(block.text, f"{page.name}:{block.line}", "exec")
        return
    code = "\n" * (block.line - 1) + room.filled(block.text)
    exec(compile(code, str(page), "exec"), names)  # noqa: S102 - our own pages


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_command_exists(page: Path) -> None:
    for step in (step for chapter in chapters(page) for step in chapter):
        if isinstance(step, Command):
            check_command(step.text)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_command_within_a_sentence_exists(page: Path) -> None:
    for text in mentioned(page):
        check_mention(text)


def has_name(module: ModuleType, name: str) -> bool:
    """Whether the module has the name, or is a package with a module of that name."""
    if hasattr(module, name) or not hasattr(module, "__path__"):
        return hasattr(module, name)
    return importlib.util.find_spec(f"{module.__name__}.{name}") is not None


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_documented_imports_exist(page: Path) -> None:
    for block in blocks(page):
        for node in ast.walk(ast.parse(block.text)) if block.language == "python" else ():
            if isinstance(node, ast.ImportFrom) and str(node.module).startswith(
                ("tableverse_factory", "workers", "schemas")
            ):
                module = importlib.import_module(str(node.module))
                missing = [alias.name for alias in node.names if not has_name(module, alias.name)]
                assert not missing, f"{page.name}:{block.line}: {node.module} has no {missing}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_block_says_what_it_holds(page: Path) -> None:
    assert [f"{page.name}:{block.line}" for block in blocks(page) if not block.language] == []


TEXTS = [step.text for page in PAGES for chapter in chapters(page) for step in chapter if isinstance(step, Command)]


def alternatives(pattern: str) -> list[str]:
    """The patterns without `|` that together match the same; one group in brackets is understood."""
    before, bracket, inside = pattern.partition("(")
    if not bracket:
        return pattern.split("|")
    group, _, after = inside.partition(")")
    first = [
        *before.split("|")[:-1],
        *(f"{before.split('|')[-1]}{each}{after.split('|')[0]}" for each in group.split("|")),
    ]
    return [*first, *after.split("|")[1:]]


@pytest.mark.parametrize("pattern", [each for pattern, _ in CANNOT for each in alternatives(pattern)])
def test_every_reason_not_to_run_something_is_needed(pattern: str) -> None:
    """Else it would hide a command that somebody writes tomorrow and that could be run."""
    assert any(re.match(pattern, text, re.DOTALL) for text in TEXTS)


def test_most_commands_are_run() -> None:
    ours = [text for text in TEXTS if "tableverse " in text]
    assert sum(why_not(text) is None for text in ours) > len(ours) / 2 > 25


@pytest.mark.parametrize(
    "typo",
    [
        "tableverse bild a b",
        "tableverse build a b --shard 3",
        "tableverse build a b --limit x",
        "tableverse view",
        "tableverse evaluate tables gone --bogus",
        "tableverse config && tableverse bild a b",
        "cd there; tableverse build a b --shard 3",
        "FAST=1 tableverse bild a b",
        "for k in 1 2; do tableverse bild a b; done",
        "tableverse build a b \\\n  --shard 3",
        "cat note | tableverse query out --lmit 3",
    ],
)
def test_a_typo_in_what_is_only_read_is_found(typo: str) -> None:
    with pytest.raises(AssertionError):
        check_command(typo)
