"""`tableverse view` as people start it: a line with the address, errors of one line, an end without a word."""

import os
import signal
import socket
import subprocess
import sys
import urllib.request

import pytest

from tests.helpers.viewer_dataset import scene_of, write_viewed_dataset

COMMAND = [sys.executable, "-c", "from tableverse_factory.cli.main import main; main()", "view"]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return write_viewed_dataset(tmp_path_factory.mktemp("viewed") / "out")


@pytest.mark.heavy
@pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGTERM])
def test_it_prints_its_address_answers_and_ends_cleanly(tmp_path, dataset, stop):
    source = dataset
    if stop == signal.SIGTERM:
        scene_of().extract(tmp_path / "scene")
        source = tmp_path / "scene" / "scene.xml"
    started = subprocess.Popen(
        [*COMMAND, str(source), "--port", "0"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONWARNINGS": "error"},
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),  # a background shell ignores it
    )
    try:
        url = started.stdout.readline().strip()
        assert url.startswith("http://127.0.0.1:")
        with urllib.request.urlopen(url, timeout=120) as page:  # noqa: S310 - our own server
            assert b"<html" in page.read()
    finally:
        started.send_signal(stop)
        said, complained = started.communicate(timeout=120)
    assert (started.returncode, said, complained) == (0, "", "")


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
