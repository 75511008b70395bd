"""Fixtures and options of all tests."""

import gc
import os
import sys
from collections.abc import Generator, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import certifi
import hypothesis
import pytest

import tests.helpers.blas_kernels  # noqa: F401 - before anything imports numpy
from tests.helpers.model_server import ModelServer, model_server
from tests.helpers.paths import ROOT, SHARED

pytest_plugins = ["tests.helpers.browser_harness", "tests.helpers.tiny_pipeline_fixtures", "tests.helpers.s3_fixtures"]

# The same examples on every machine. `--hypothesis-profile=default` looks further.
hypothesis.settings.register_profile("same-everywhere", derandomize=True, deadline=None)
hypothesis.settings.register_profile("fewer", derandomize=True, deadline=None, max_examples=30)
hypothesis.settings.load_profile("same-everywhere")

AUTHORITIES = {
    name: os.environ.get(name) for name in ("SSL_CERT_FILE", "REQUESTS_CA_BUNDLE", "CURL_CA_BUNDLE", "AWS_CA_BUNDLE")
}
PROCESS_EVENTS = {"subprocess.Popen", "os.fork", "os.forkpty", "os.posix_spawn", "os.exec"}


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--fast", action="store_true", help="only tests that compute briefly and start no process")


def pytest_configure(config: pytest.Config) -> None:
    if config.getoption("--fast"):
        config.option.markexpr = "not slow and not heavy"
        sys.addaudithook(refuse_processes)
    if "not slow" in config.option.markexpr and config.option.hypothesis_profile is None:
        hypothesis.settings.load_profile("fewer")  # where slow tests run, the examples are three times as many


def refuse_processes(event: str, arguments: tuple[object, ...]) -> None:
    """Fail a fast test that starts a process: it has to be marked `heavy`."""
    if event in PROCESS_EVENTS and _running:
        raise AssertionError(f"{_running[0]} starts a process ({event}): mark it `heavy`")


_running: list[str] = []


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    _running.append(item.nodeid)
    try:
        return (yield)
    finally:
        _running.clear()


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    return True if config.getoption("--fast") and "integration" in collection_path.parts else None


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Keep imported and collected objects out of garbage collection, which takes a fifth of the time."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files that start builds begin first, or a long one would end alone; `--no-loadscope-reorder` keeps this order."""
    items.sort(key=lambda item: not {"integration", "workers"} & set(item.path.relative_to(ROOT).parts))


@pytest.fixture(scope="session", autouse=True)
def ray_leaves_nothing() -> Iterator[None]:
    """A folder for Ray's sessions, removed at the end; `tmp_path` is too long for its sockets."""
    with (
        TemporaryDirectory(prefix="tv-", ignore_cleanup_errors=True) as folder,
        pytest.MonkeyPatch.context() as patched,
    ):
        patched.setenv("RAY_TMPDIR", folder)
        yield


@pytest.fixture(scope="session", autouse=True)
def one_authority(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """One certificate authority for all clients: each would parse some 150, for 30 ms, and no test asks one."""
    begin, end = "-----BEGIN CERTIFICATE-----", "-----END CERTIFICATE-----"
    first = begin + Path(certifi.where()).read_text().partition(begin)[2].partition(end)[0] + end
    path = tmp_path_factory.mktemp("authority") / "one.pem"
    path.write_text(first)
    with pytest.MonkeyPatch.context() as patched:
        for variable in AUTHORITIES:
            patched.setenv(variable, str(path))
        yield


@pytest.fixture
def own_authorities(monkeypatch: pytest.MonkeyPatch) -> None:
    """The authorities that this machine trusts, for a test that asks its package index."""
    for variable, path in AUTHORITIES.items():
        if path is None:
            monkeypatch.delenv(variable)
        else:
            monkeypatch.setenv(variable, path)


@pytest.fixture(scope="session")
def shared_dir() -> Path:
    """The evaluation data beside the checkout: real captures, scanned meshes, cluttered layouts."""
    if not SHARED.is_dir():
        pytest.skip("the evaluation data is not beside this checkout")
    return SHARED


@pytest.fixture
def server() -> Iterator[ModelServer]:
    """A model's server on this machine with scripted answers."""
    with model_server() as running:
        yield running


@pytest.fixture
def run(monkeypatch, capsys):
    """Run the command line; return exit code, stdout and stderr."""

    from tableverse_factory.cli.main import main

    def run_command(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr("sys.argv", ["tableverse", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            main()
        captured = capsys.readouterr()
        return ended.value.code or 0, captured.out, captured.err

    return run_command
