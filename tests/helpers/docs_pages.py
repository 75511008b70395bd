"""What README.md and docs/*.md tell a reader to type, in the order of the page.

A block says what it holds: `sh` is commands to copy, one to a line; `console` is a transcript, commands after `$ ` and
what they answer below; `python` is run too; everything else (`text`, `yaml`, `json`, …) is only read.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from tests.helpers.paths import ROOT

PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")))
SHELL = ("bash", "console", "sh", "shell")
PROMPT = "$ "
PROGRAMS = ("make", "pip", "python", "tableverse")
AFRESH = "<!-- afresh -->"
"""Stands in a page where what follows does not go on with what its commands have left."""

_FENCE = re.compile(r"( *)(`{3,})(.*)")
_HEREDOC = re.compile(r"<<-?\s*(['\"]?)(\w+)\1")
_INLINE = re.compile(r"(?<!`)`(tableverse [^`]+)`(?!`)")


@dataclass(frozen=True)
class Block:
    """A fenced block: its language, the line of the page on which its text begins, the text; afresh after `AFRESH`."""

    language: str
    line: int
    text: str
    afresh: bool = False


@dataclass(frozen=True)
class Command:
    """What to type, as it stands there, and what the page says that it answers."""

    line: int
    text: str
    answer: tuple[str, ...] = ()


@cache
def blocks(page: Path) -> tuple[Block, ...]:
    """Every fenced block of the page; one inside a list or an admonition loses its indentation."""
    found: list[Block] = []
    opened: re.Match[str] | None = None
    text: list[str] = []
    afresh = False
    for number, line in enumerate(page.read_text().splitlines(), 1):
        match = _FENCE.fullmatch(line)
        if opened is None:
            afresh = afresh or line.strip() == AFRESH
            if match:
                opened, start, text = match, number + 1, []
        elif match and match[2] == opened[2] and not match[3].strip():
            language = opened[3].split()[0].strip("{.}") if opened[3].strip() else guessed(text)
            found.append(Block(language, start, "\n".join(text), afresh))
            opened, afresh = None, False
        else:
            text.append(line.removeprefix(opened[1]))
    assert opened is None, f"{page.name}: a block is not closed"
    return tuple(found)


def guessed(text: list[str]) -> str:
    """Of a block that does not say what it holds: `sh` where it begins like a command, else nothing."""
    return "sh" if text and text[0].split()[:1] in ([program] for program in PROGRAMS) else ""


def commands(block: Block) -> Iterator[Command]:
    """The commands of a shell block, each whole: continued lines and here-documents are one."""
    lines = block.text.splitlines()
    prompted = any(line.startswith(PROMPT) for line in lines)
    number = 0
    while number < len(lines):
        start = number
        if prompted and not lines[number].startswith(PROMPT):
            number += 1
            continue
        text = lines[number].removeprefix(PROMPT) if prompted else lines[number]
        while text.endswith("\\"):
            number += 1
            text = f"{text}\n{lines[number]}"
        if heredoc := _HEREDOC.search(text):
            while lines[number].strip() != heredoc[2]:
                number += 1
                text = f"{text}\n{lines[number]}"
        number += 1
        answer = []
        while prompted and number < len(lines) and not lines[number].startswith(PROMPT):
            answer.append(lines[number])
            number += 1
        if text.strip() and not text.lstrip().startswith("#"):
            yield Command(block.line + start, text.strip(), tuple(answer))


def mentioned(page: Path) -> Iterator[str]:
    """Commands within a sentence or a table, such as `tableverse status OUT --watch`."""
    fenced = {line for block in blocks(page) for line in block.text.splitlines()}
    prose = "\n".join(line for line in page.read_text().splitlines() if line not in fenced)
    for match in _INLINE.finditer(prose):
        yield " ".join(match[1].split())


def find_example(page: str, words: str) -> Block:
    """The one Python block of a page of docs/ that has these words."""
    (block,) = (its for its in blocks(ROOT / "docs" / page) if its.language == "python" and words in its.text)
    return block


def run_example(page: str, words: str, **names: object) -> dict[str, object]:
    """Run such a block with names that the reader has; return all that it has then."""
    block = find_example(page, words)
    exec(compile("\n" * (block.line - 1) + block.text, page, "exec"), names)  # noqa: S102 - our own pages
    return names
