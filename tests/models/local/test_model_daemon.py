"""One process for one model: it is started once, batches what comes together, and its death costs a retry."""

import os
import select
import socket
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from tableverse_factory.core.errors import ModelAccessError, ModelError
from tableverse_factory.core.framing import encode_header
from tableverse_factory.models.local import batch_server, model_daemon
from tableverse_factory.models.local.batch_server import REFUSED, serve_batches
from tableverse_factory.models.local.wire import WireError, decode_error, receive_arrays, send_arrays
from tests.helpers.paths import ROOT

pytestmark = pytest.mark.heavy


@pytest.fixture
def desk(tmp_path):
    """A server in a thread, for an answer of one's own, and how to connect to it."""
    threads, ends = [], []

    def start(answer, most=4):
        path = tmp_path / f"{len(threads)}.sock"
        listener = socket.socket(socket.AF_UNIX)
        listener.bind(str(path))
        listener.listen(64)
        guard = socket.socket(socket.AF_UNIX)  # connected before the server starts: it never finds itself idle
        guard.connect(str(path))
        ends.append(guard)
        thread = threading.Thread(target=serve_batches, args=(listener, path, most, lambda _: answer, 0.1), daemon=True)
        thread.start()
        threads.append((thread, path))

        def connect():
            end = socket.socket(socket.AF_UNIX)
            end.connect(str(path))
            end.settimeout(20)
            ends.append(end)
            return end

        return connect

    yield start
    for end in ends:
        end.close()
    for thread, path in threads:
        thread.join(timeout=20)
        assert not thread.is_alive(), "the process stays although nobody is connected"
        assert not path.exists()


def doubled(questions):
    return [(2 * array,) for (array,) in questions]


def test_what_is_asked_while_the_model_works_goes_through_it_together(desk):
    sizes, free = [], threading.Event()

    def answer(questions):
        if not sizes:
            free.wait(20)  # a first forward, during which others ask
        sizes.append(len(questions))
        return doubled(questions)

    connect = desk(answer)
    ends = [connect() for _ in range(7)]
    for k, end in enumerate(ends):
        send_arrays(end, [np.array([k])])
        if k == 0:
            time.sleep(0.1)
    free.set()
    for k, end in enumerate(ends):
        fine, twice = receive_arrays(end)
        assert (fine.tolist(), twice.tolist()) == ([1], [2 * k])
    assert sizes == [1, 4, 2]


def test_a_question_that_cannot_be_answered_harms_no_neighbour(desk):
    def answer(questions):
        if any(int(array[0]) == 2 for (array,) in questions):
            raise ModelError("two is too much")
        return doubled(questions)

    connect = desk(answer)
    ends = [connect() for _ in range(4)]
    for k, end in enumerate(ends):
        send_arrays(end, [np.array([k])])
    for k, end in enumerate(ends):
        first, second = receive_arrays(end)
        if k == 2:
            assert first.tolist() == REFUSED.tolist()
            assert decode_error(second) == ("ModelError", "two is too much")
        else:
            assert second.tolist() == [2 * k]


def test_who_has_an_answer_need_not_wait_for_the_others_of_the_batch(desk):
    heard = threading.Event()

    def answer(questions):
        yield from doubled(questions[:1])
        assert heard.wait(20)
        yield from doubled(questions[1:])

    connect = desk(answer)
    ends = [connect() for _ in range(2)]
    for k, end in enumerate(ends):
        send_arrays(end, [np.array([k])])
    assert receive_arrays(ends[0])[1].tolist() == [0]
    heard.set()
    assert receive_arrays(ends[1])[1].tolist() == [2]


def test_what_a_person_must_see_to_is_told_to_all_and_tried_once(desk):
    asked, free = [], threading.Event()

    def answer(questions):
        free.wait(20)
        asked.append(len(questions))
        raise ModelAccessError("the disk is full")

    connect = desk(answer)
    ends = [connect() for _ in range(4)]
    for k, end in enumerate(ends):
        send_arrays(end, [np.array([k])])
    time.sleep(0.2)
    free.set()
    assert [decode_error(receive_arrays(end)[1])[0] for end in ends] == ["ModelAccessError"] * 4
    assert sum(asked) == 4


def test_an_error_of_the_model_harms_no_neighbour_and_leaves_the_process(desk):
    def answer(questions):
        if any(int(array[0]) == 2 for (array,) in questions):
            raise RuntimeError("a kernel refuses this picture")
        return doubled(questions)

    connect = desk(answer)
    ends = [connect() for _ in range(4)]
    for _ in range(2):
        for k, end in enumerate(ends):
            send_arrays(end, [np.array([k])])
        answers = [receive_arrays(end) for end in ends]
        kind, said = decode_error(answers[2][1])
        assert (kind, "a kernel refuses" in said) == ("ModelError", True)
        assert [answers[k][1].tolist() for k in (0, 1, 3)] == [[0], [2], [6]]


def test_who_talks_slowly_holds_nobody_up_for_longer_than_one_message_may_take(desk, monkeypatch):
    monkeypatch.setattr(batch_server, "MESSAGE_S", 0.3)
    connect = desk(doubled)
    slow, good = connect(), connect()
    stop = threading.Event()

    def drip():
        slow.sendall(encode_header(bytes(1000), b"0"))
        while not stop.wait(0.1):
            try:
                slow.sendall(b"x")
            except OSError:
                return

    thread = threading.Thread(target=drip, daemon=True)
    thread.start()
    time.sleep(0.1)
    began = time.monotonic()
    send_arrays(good, [np.array([21])])
    assert receive_arrays(good)[1].tolist() == [42]
    assert time.monotonic() - began < 2.0
    stop.set()
    thread.join(timeout=20)


@pytest.mark.parametrize("shape", ["(100000000000000,)", "(" * 100, "(-1,)", "'x'"])
def test_a_header_that_describes_no_array_is_no_message(shape):
    header = f"{{'descr':'<f8','fortran_order':False,'shape':{shape}"
    header += "}" if shape[-1] != "(" else ""
    padded = header.encode() + b" " * (-(len(header) + 11) % 64) + b"\n"
    array = b"\x93NUMPY\x01\x00" + len(padded).to_bytes(2, "little") + padded
    left, right = socket.socketpair()
    with left, right:
        left.sendall(encode_header(array, b"0") + array)
        left.shutdown(socket.SHUT_WR)
        with pytest.raises(WireError):
            receive_arrays(right)


def test_who_hangs_up_or_talks_nonsense_is_forgotten(desk):
    connect = desk(doubled)
    gone, rude, huge, good = (connect() for _ in range(4))
    send_arrays(gone, [np.array([1])])
    gone.close()
    rude.sendall(b"GET / HTTP/1.1\r\n\r\n")
    huge.sendall(encode_header(b"")[:-8] + b"\xff" * 8)
    for end in (rude, huge):
        with pytest.raises(WireError):
            receive_arrays(end)
    send_arrays(good, [np.array([21])])
    assert receive_arrays(good)[1].tolist() == [42]


def test_who_asks_and_hangs_up_ends_the_process_for_nobody_else(desk):
    connect = desk(doubled)
    gone, good = connect(), connect()
    send_arrays(gone, [np.array([1])])
    gone.close()
    time.sleep(0.1)  # longer than a batch is waited for
    send_arrays(good, [np.array([21])])
    assert receive_arrays(good)[1].tolist() == [42]


def test_no_pickle_passes():
    left, right = socket.socketpair()
    with left, right, pytest.raises(ValueError, match="Object arrays"):
        send_arrays(left, [np.array([{}], dtype=object)])


@pytest.fixture
def folder(monkeypatch):
    """Where the processes listen, for this test alone; the path of a `tmp_path` may be too long for a socket."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]))
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as short:
        monkeypatch.setenv("XDG_RUNTIME_DIR", short)
        yield Path(short)
        model_daemon.close_connections()


def test_a_process_is_started_once_and_again_after_its_death(folder, tmp_path):
    spec = {"mark": str(tmp_path / "mark")}
    assert model_daemon.ask_daemon("tests.helpers.doubling_process", spec, [np.array([4])])[0].tolist() == [8]
    assert model_daemon.ask_daemon("tests.helpers.doubling_process", spec, [np.array([13])])[0].tolist() == [26]
    assert (tmp_path / "mark").exists()  # it did die
    found = list(folder.glob("*/*.sock"))
    assert len(found) == 1
    assert found[0].parent.stat().st_mode & 0o777 == 0o700


def test_who_is_interrupted_does_not_take_the_answer_for_that_to_the_next_question(folder, tmp_path, monkeypatch):
    def interrupted(end):
        assert select.select([end], [], [], 20.0)[0], "the answer is there, and nobody has read it"
        raise KeyboardInterrupt

    spec = {"mark": str(tmp_path / "mark")}
    assert model_daemon.ask_daemon("tests.helpers.doubling_process", spec, [np.array([1])])[0].tolist() == [2]
    with monkeypatch.context() as meanwhile:
        meanwhile.setattr(model_daemon, "receive_arrays", interrupted)
        with pytest.raises(KeyboardInterrupt):
            model_daemon.ask_daemon("tests.helpers.doubling_process", spec, [np.array([2])])
    assert model_daemon.ask_daemon("tests.helpers.doubling_process", spec, [np.array([50])])[0].tolist() == [100]


def test_a_model_that_cannot_be_had_is_told_to_the_asker(folder):
    with pytest.raises(ModelAccessError, match="no weights for this one"):
        model_daemon.ask_daemon("tests.helpers.doubling_process", {"refuses": 1}, [np.array([4])])


def test_a_model_that_does_not_fit_is_told_once_and_for_all(folder):
    with pytest.raises(ModelAccessError, match="does not fit"):
        model_daemon.ask_daemon("tests.helpers.doubling_process", {"too_large": 1}, [np.array([4])])


def test_a_process_that_does_not_start_is_an_error_that_tells_of_its_log_and_no_path(folder):
    with pytest.raises(ModelError, match=r"\.log") as told:
        model_daemon.ask_daemon("no_such_module_here", {}, [np.array([4])])
    assert str(folder) not in str(told.value), "messages go into datasets"
    (log,) = folder.glob("*/*.log")
    assert "No module named" in log.read_text()


def test_other_weights_in_the_same_folder_are_another_process(folder, tmp_path):
    weights = tmp_path / "weights"
    weights.mkdir()
    spec = {"mark": str(tmp_path), "weights": str(weights)}
    (weights / "model.safetensors").write_bytes(b"one")
    one = model_daemon.compute_socket_path("tests.helpers.doubling_process", spec)
    assert model_daemon.compute_socket_path("tests.helpers.doubling_process", spec) == one
    (weights / "model.safetensors").write_bytes(b"other")
    assert model_daemon.compute_socket_path("tests.helpers.doubling_process", spec) != one


@pytest.mark.parametrize("given", ["nowhere", "x" * 90])
def test_without_a_folder_for_sockets_the_one_for_temporary_files_does(folder, tmp_path, monkeypatch, given):
    (tmp_path / ("x" * 90)).mkdir()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / given))
    found = model_daemon.compute_socket_path("tests.helpers.doubling_process", {})
    assert found.parent.parent == Path(tempfile.gettempdir())
    assert len(str(found)) <= 107


def test_a_folder_of_somebody_else_is_not_used(folder):
    (folder / f"tableverse-{os.getuid()}").mkdir(mode=0o777)
    (folder / f"tableverse-{os.getuid()}").chmod(0o777)
    with pytest.raises(ModelAccessError, match="this user alone"):
        model_daemon.ask_daemon("tests.helpers.doubling_process", {}, [np.array([4])])
