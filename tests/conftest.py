"""What every test may lean on."""

from collections.abc import Iterator
from pathlib import Path

import hypothesis
import pytest
from model_server import ModelServer, model_server

pytest_plugins = ["browser_harness"]

# The same examples everywhere: a law that fails, fails for everybody. `--hypothesis-profile=default` looks further.
hypothesis.settings.register_profile("same-everywhere", derandomize=True, deadline=None)
hypothesis.settings.load_profile("same-everywhere")


@pytest.fixture(scope="session")
def shared_dir() -> Path:
    """The evaluation data beside the checkout: real captures, scanned meshes, cluttered layouts."""
    path = Path(__file__).resolve().parents[2] / "shared"
    if not path.is_dir():
        pytest.skip("the evaluation data is not beside this checkout")
    return path


@pytest.fixture
def server() -> Iterator[ModelServer]:
    """A model's server on this machine that says what the test tells it to."""
    with model_server() as running:
        yield running


@pytest.fixture
def run(monkeypatch, capsys):
    """Runs the command line; returns exit code, stdout and stderr."""

    from tableverse_factory.cli.main import main

    def run_command(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr("sys.argv", ["tableverse", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            main()
        captured = capsys.readouterr()
        return ended.value.code or 0, captured.out, captured.err

    return run_command
