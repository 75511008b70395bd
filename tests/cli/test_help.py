"""Help that teaches: short, in groups, and every example is understood by the command that it stands in."""

import re
import shlex

import pytest
import typer

from tableverse_factory.cli.main import COMMANDS, FIRST_STEPS, PANELS, app

ROOF = typer.main.get_command(app)
CONTEXT = ROOF.make_context("tableverse", [], resilient_parsing=True)
WIDTH = 80


def commands():
    """Every command with the words that lead to it, those of groups too."""
    for name in ROOF.list_commands(CONTEXT):
        command = ROOF.get_command(CONTEXT, name)
        if hasattr(command, "commands"):
            yield from (((name, below), each) for below, each in command.commands.items())
        else:
            yield (name,), command


def typed(text: str) -> list[list[str]]:
    """The command lines of ours in a piece of shell, as words."""
    lines = re.split(r"&&|\||;", " ".join(text.split()))
    return [words[1:] for line in lines if (words := shlex.split(line)) and words[0] == "tableverse"]


EXAMPLES = [
    pytest.param(line, id=" ".join(line))
    for _, command in commands()
    for text in re.findall(r"`([^`]+)`", (command.help or "").partition("Example")[2])
    for line in typed(text)
]


def understood(words: list[str]) -> None:
    """Parses a command line as it would be run, and runs nothing."""
    context, command = CONTEXT, ROOF
    while hasattr(command, "commands"):
        command.parse_args(context, words)  # as `export OUT DEST`, which stands for `export dataset`
        name, command, words = command.resolve_command(context, [*context._protected_args, *context.args])
        if hasattr(command, "commands"):
            context = command.make_context(name, list(words), parent=context, resilient_parsing=True)
        else:
            command.make_context(name, list(words), parent=context)


@pytest.mark.parametrize("words", EXAMPLES)
def test_every_example_is_understood(words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in (
        "captures",
        "meshes",
        "layouts/truth",
        "results",
        "demo/layouts",
        "demo/truth",
        "truth",
        "pictures",
        "out",
    ):
        (tmp_path / name).mkdir(parents=True, exist_ok=True)
    understood(words)


def test_every_command_has_an_example_of_its_own():
    for words, command in commands():
        examples = [
            line
            for text in re.findall(r"`([^`]+)`", (command.help or "").partition("Example")[2])
            for line in typed(text)
        ]
        assert any(tuple(line[: len(words)]) == words for line in examples), words


def test_the_first_steps_are_understood_in_their_order(tableverse):
    answer = tableverse()
    assert (answer.code, answer.out, answer.err) == (0, FIRST_STEPS, "")
    lines = [line.split("   ")[0].strip() for line in answer.out.splitlines() if line.startswith("  tableverse ")]
    steps = [words for line in lines for words in typed(line)]
    assert [step[0] for step in steps] == ["doctor", "synth", "manifest", "build", "report", "view", "status"]
    for step in steps:
        understood(step)
    assert max(map(len, answer.out.splitlines())) <= 100


def test_the_list_of_commands_can_be_taken_in_at_a_glance(tableverse, monkeypatch):
    """At 80 columns a line each, in their panels, on one screen and a half."""
    monkeypatch.setenv("COLUMNS", str(WIDTH))
    out = tableverse("--help").out
    lines = out.splitlines()
    assert max(map(len, lines)) <= WIDTH
    for panel, names in PANELS.items():
        title = next(i for i, line in enumerate(lines) if panel in line)
        listed = [re.match(r"│ ([a-z]+) ", line) for line in lines[title + 1 : title + 1 + len(names)]]
        assert lines[title + 1 + len(names)].startswith("╰")
        assert [match and match[1] for match in listed] == [*names], f"{panel}: a line each, in order"
    assert len(lines) < 60


@pytest.mark.parametrize("width", [40, 80])
@pytest.mark.parametrize("terminal", ["dumb", "xterm-256color"])
def test_help_fits_every_terminal(tableverse, monkeypatch, width, terminal):
    monkeypatch.setenv("COLUMNS", str(width))
    monkeypatch.setenv("TERM", terminal)
    for name in ("build", "query"):
        out = tableverse(name, "--help").out
        assert max(map(len, out.splitlines())) <= width
        assert "\x1b" not in out


def test_options_of_one_name_have_one_meaning():
    """The same letters for the same thing in every command."""
    short: dict[str, set[str]] = {}
    kinds: dict[str, set[str]] = {}
    for _, command in commands():
        for parameter in command.params:
            long = next((name for name in parameter.opts if name.startswith("--")), None)
            for name in parameter.opts:
                if long and name.startswith("-") and not name.startswith("--"):
                    short.setdefault(name, set()).add(long)
            if long in ("--json", "--config", "--set", "--robot", "--jobs"):
                kinds.setdefault(long, set()).add(parameter.display_type_rich(CONTEXT))
    assert not {name: longs for name, longs in short.items() if len(longs) > 1 and name != "-n"}
    assert set(kinds) == {"--json", "--config", "--set", "--robot", "--jobs"}
    assert all(len(kind) == 1 for name, kind in kinds.items() if name in ("--json", "--set")), kinds


def test_commands_stand_in_one_panel_each():
    assert sorted(name for panel in PANELS.values() for name in panel) == sorted(COMMANDS)
