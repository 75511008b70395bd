"""`tableverse view` as people start it: a line with the address, errors of one line, an end without a word."""

import os
import shutil
import signal
import socket
import subprocess
import sys
import urllib.request
from contextlib import contextmanager
from urllib.parse import urlsplit

import pytest

from tableverse_factory import open_dataset
from tableverse_factory.dataset.shards import shard_path
from tests.helpers.viewer_dataset import scene_of, write_viewed_dataset

COMMAND = [sys.executable, "-c", "from tableverse_factory.cli.main import main; main()", "view"]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return write_viewed_dataset(tmp_path_factory.mktemp("viewed") / "out")


@contextmanager
def started(source, stop=signal.SIGTERM):
    """A viewer, until the end of the block; then `communicate` gives what it wrote."""
    process = subprocess.Popen(
        [*COMMAND, str(source), "--port", "0"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONWARNINGS": "error"},
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),  # a background shell ignores it
    )
    try:
        yield process
    finally:
        process.send_signal(stop)
        process.wait(timeout=120)


@pytest.mark.heavy
@pytest.mark.parametrize("stop", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)])
def test_it_prints_its_address_answers_and_ends_cleanly(tmp_path, dataset, stop):
    source = dataset
    if stop == signal.SIGTERM:
        scene_of().extract(tmp_path / "scene")
        source = tmp_path / "scene" / "scene.xml"
    with started(source, stop) as view:
        url = view.stdout.readline().strip()
        assert url.startswith("http://127.0.0.1:")
        for request in (b"HEAD / HTTP/1.1\r\n\r\n", b"no HTTP\r\n\r\n"):
            with socket.create_connection(("127.0.0.1", urlsplit(url).port)) as other:
                other.sendall(request)
                assert other.recv(1) == b"", "it hangs up"
        with urllib.request.urlopen(url, timeout=120) as page:  # noqa: S310 - our own server
            assert b"<html" in page.read()
    assert (view.returncode, *view.communicate()) == (0, "", "")


def test_a_port_in_use_is_said_in_one_line(dataset, run):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        code, said, complained = run("view", dataset, "--port", port)
    assert (code, said) == (1, "")
    assert complained.startswith(f"error: cannot listen on 127.0.0.1 port {port}: ")
    assert "--port 0" in complained
    assert complained.count("\n") == 2, "the error, and where to read on"


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("none",), "no such folder"),
        (("none/scene.xml",), "no such file"),
        (("{out}", "a-2"), "no scene 'a-2'; nearest: "),
        (("scene.xml", "a-2"), "scene.xml is one scene"),
        (("{out}", "--host", "no.such.host.invalid"), "no address of this machine"),
        (("{out}", "--host", "192.0.2.1"), "cannot listen on 192.0.2.1"),
        (("{out}", "--allow-origin", "lab"), "--allow-origin lab: not the address of a page"),
    ],
)
def test_mistakes_are_told_in_one_line(dataset, run, arguments, said):
    code, out, complained = run("view", *(each.format(out=dataset) for each in arguments))
    assert (code, out) == (1, "")
    assert said in complained
    assert complained.count("\n") == 2, "the error, and where to read on"


@pytest.mark.slow  # a process more
@pytest.mark.heavy
def test_a_damaged_scene_is_skipped_in_one_line(tmp_path, dataset):
    out = tmp_path / "out"
    shutil.copytree(dataset, out)
    _damage(out, "a-1")
    with started(out) as view:
        assert view.stdout.readline().startswith("http://127.0.0.1:")
    assert view.communicate()[1].startswith("skipped 1 damaged scene: scene a-1: ")


def test_where_all_scenes_are_damaged_the_first_says_why(tmp_path, dataset, run):
    out = tmp_path / "out"
    shutil.copytree(dataset, out)
    _damage(out, "a-1", "b-2")
    code, said, complained = run("view", out)
    assert (code, said) == (1, "")
    assert complained.startswith("error: scene a-1: ")


def _damage(out, *scene_ids):
    rows = open_dataset(out).scenes.to_table().to_pylist()
    with shard_path(out, "mjcf", 0).open("r+b") as tar:
        for row in rows:
            if row["scene_id"] in scene_ids:
                tar.seek(row["tar_offset"])
                tar.write(b"\xff" * 512)
