"""What every test may lean on."""

import gc
from collections.abc import Generator, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import hypothesis
import pytest
from hypothesis.internal.conjecture import providers

from tests.helpers.model_server import ModelServer, model_server
from tests.helpers.paths import SHARED

pytest_plugins = ["tests.helpers.browser_harness", "tests.helpers.marks_fixture", "tests.helpers.s3_fixtures"]

# The same examples everywhere: a law that fails, fails for everybody. `--hypothesis-profile=default` looks further.
# It would draw constants of whatever modules are imported by then, which depends on what ran before in this process.
providers.is_local_module_file = lambda path: False
hypothesis.settings.register_profile("same-everywhere", derandomize=True, deadline=None)
hypothesis.settings.load_profile("same-everywhere")


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """What is imported and collected stays: looking through it for garbage takes a fifth of the time."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Integration tests begin first, since they take longest; `--no-loadscope-reorder` keeps this order."""
    items.sort(key=lambda item: "integration" not in item.path.parts)


@pytest.fixture(scope="session", autouse=True)
def ray_leaves_nothing() -> Iterator[None]:
    """Ray keeps the folder of every session; here, until the tests are over. `tmp_path` is too long for its sockets."""
    with (
        TemporaryDirectory(prefix="tv-", ignore_cleanup_errors=True) as folder,
        pytest.MonkeyPatch.context() as patched,
    ):
        patched.setenv("RAY_TMPDIR", folder)
        yield


@pytest.fixture(scope="session")
def shared_dir() -> Path:
    """The evaluation data beside the checkout: real captures, scanned meshes, cluttered layouts."""
    if not SHARED.is_dir():
        pytest.skip("the evaluation data is not beside this checkout")
    return SHARED


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
