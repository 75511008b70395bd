"""The command line as a user meets it: arguments in, exit code and two streams out."""

import sys
from collections.abc import Callable
from dataclasses import dataclass

import pytest

from tableverse_factory.cli.main import main


@dataclass(frozen=True)
class Answer:
    code: int
    out: str
    err: str


@pytest.fixture
def tableverse(monkeypatch, capsys) -> Callable[..., Answer]:
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.delenv("TABLEVERSE_DEBUG", raising=False)

    def run(*arguments: object) -> Answer:
        monkeypatch.setattr(sys, "argv", ["tableverse", *map(str, arguments)])
        with pytest.raises(SystemExit) as exit_:
            main()
        captured = capsys.readouterr()
        return Answer(int(exit_.value.code or 0), captured.out, captured.err)

    return run
