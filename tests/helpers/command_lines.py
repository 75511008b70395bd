"""Command lines that are read by the real command line but not run."""

import itertools
import re
import shlex
from collections.abc import Sequence
from typing import Any

import typer

from tableverse_factory.cli.main import app
from tableverse_factory.cli.submit import parse_build
from tableverse_factory.core.config import build_config

ROOT = typer.main.get_command(app)
UsageError = typer.BadParameter.__mro__[1]
"""Of the click that Typer brings along."""
_REDIRECTION = re.compile(r"\d?[<>]{1,2}")
_BEFORE = re.compile(r"\w+=|(do|then|if|while|time|!)$")
"""Words that stand before a command: settings of the environment, and words of the shell."""


def check_command(text: str) -> None:
    """Commands, options and their values exist, also those of the configuration; other programs' are not looked at.

    All commands of a line are read, behind `&&` and `|` too.
    """
    reader = shlex.shlex(text.replace("\\\n", " "), posix=True, punctuation_chars="|&;\n")
    reader.whitespace, reader.whitespace_split = " \t", True
    for joins, words in itertools.groupby(reader, key=lambda word: set(word) <= set("|&;\n")):
        if not joins:
            _check_one(text, list(words))


def _check_one(text: str, words: Sequence[str]) -> None:
    words = [*itertools.dropwhile(_BEFORE.match, words)]
    if not words or words[0] != "tableverse":
        return
    arguments = words[1 : next((i for i, word in enumerate(words) if _REDIRECTION.match(word)), len(words))]
    try:
        context = parse(arguments)
        if context.info_name == "submit":
            parse_build(["images.parquet", "out", *(context.params["options"] or [])])
    except UsageError as error:
        # names of options are looked at before values: only that a file of the page is not there is no mistake of its
        if "does not exist" in str(error):
            return
        raise AssertionError(f"{text}: {error}") from None
    if overrides := context.params.get("overrides"):
        build_config({}, overrides)


def parse(arguments: Sequence[str]) -> Any:
    """What the command line understands; nothing is run.

    Raises:
        UsageError: if it does not.
    """
    command: Any = ROOT
    context = command.make_context("tableverse", list(arguments))
    while hasattr(command, "resolve_command"):
        name, command, rest = command.resolve_command(context, [*context._protected_args, *context.args])
        context = command.make_context(name, list(rest), parent=context)
    return context


def check_mention(text: str) -> None:
    """A command named in a sentence, arguments left out or in capitals, has the options that are named with it."""
    words = text.replace("…", " ").replace("...", " ").split()[1:]
    command, rest = _find(words)
    known = {option for parameter in command.params for option in (*parameter.opts, *parameter.secondary_opts)}
    named = {word.partition("=")[0] for word in rest if word.startswith("-") and word != "--"}
    assert named <= {*known, "--help", "-h"}, f"{text}: {command.name} has no {', '.join(sorted(named - known))}"


def _find(words: Sequence[str]) -> tuple[Any, Sequence[str]]:
    command: Any = ROOT
    while hasattr(command, "commands") and words and not words[0].startswith("-") and not words[0].isupper():
        assert words[0] in command.commands, f"no command {words[0]!r}; there are {', '.join(command.commands)}"
        command, words = command.commands[words[0]], words[1:]
    return command, words
