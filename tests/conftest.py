"""What every test may lean on."""

import gc
from collections.abc import Generator, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import hypothesis
import pytest
from hypothesis.internal.conjecture import providers
from model_server import ModelServer, model_server

pytest_plugins = ["browser_harness"]

TESTS = Path(__file__).parent
LONGEST = (
    "ray/test_ray_build.py",
    "report/test_gallery_pages.py",
    "storage/test_store_builds.py",
    "workers/test_poison.py",
    "workers/test_build.py",
    "hub/test_publishing.py",
    "workers/test_trajectories_build.py",
    "workers/test_sandbox.py",
    "docs/test_documented_commands.py",
    "cli/test_progress.py",
    "storage/test_store_inputs.py",
    "trajectories/test_trajectories.py",
    "docs/test_contributing.py",
    "workers/test_again.py",
    "curate/test_provider_failures.py",
    "report/test_gallery_effort.py",
    "workers/test_judge_build.py",
    "formats/test_physics_of_builds.py",
    "test_verification.py",
    "workers/test_again_stopped.py",
    "cli/test_endings.py",
    "proof/test_replayed_motions.py",
    "workers/test_disk_full.py",
    "geometry/test_bad_meshes.py",
    "curate/test_tasks.py",
    "ray/test_real_line.py",
)
"""Files of ten seconds and more. They begin first: one that begins last keeps one core busy and the others idle."""

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
    """What takes longest first, then as it was found; `--no-loadscope-reorder` keeps this order."""
    rank = {TESTS / name: k for k, name in enumerate(LONGEST)}
    assert all(path.is_file() for path in rank), "LONGEST names files that are gone"
    items.sort(key=lambda item: rank.get(item.path, len(rank)))


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
