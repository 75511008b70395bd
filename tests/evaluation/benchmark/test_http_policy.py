"""A policy in another process: what it is told arrives whole, and no answer of it harms the benchmark."""

import http.client
import json
import signal
import socket
import subprocess
import sys
import threading
import time
from http.server import BaseHTTPRequestHandler

import numpy as np
import pytest

from schemas.curation import Relation
from schemas.geometry import Pose
from tableverse_factory.core.errors import ConfigError, InputError
from tableverse_factory.evaluation.benchmark.http_policy import MAX_ANSWER_BYTES, HttpPolicy
from tableverse_factory.evaluation.benchmark.json_arrays import decode_array, decode_start, encode_array, encode_start
from tableverse_factory.evaluation.benchmark.policy import EpisodeStart, PolicyError, PolicyGoneError
from tableverse_factory.evaluation.benchmark.policy_server import PolicyServer
from tests.helpers.loopback import serving


def start() -> EpisodeStart:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(3, 16, 3)).astype(np.float32)
    base = Pose(np.array([0.1, -0.5, 0.0]), np.array([0.8, 0.0, 0.0, 0.6]))
    return EpisodeStart(
        "test_0000", 7, "Pick up the mug", Relation.ON, points, "panda", base, -np.ones(8), np.ones(8), 0.02, 500
    )


class Echo:
    """Answers with what it was told, so that a test sees what arrived."""

    pictures = ("front", "front_depth")
    picture_size = (4, 6)

    def reset(self, start: EpisodeStart) -> None:
        if start.seed == 13:
            raise ValueError("thirteen")
        self.start = start

    def act(self, observation) -> np.ndarray:
        assert observation["front"].dtype == np.uint8
        return np.array([observation["state"][0], observation["front"].sum(), *self.start.points[0, 0], 0, 0, 0])


@pytest.fixture
def address():
    with PolicyServer(Echo, 0) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()
        thread.join()


def test_what_is_told_and_seen_arrives_exactly(address):
    told, policy = start(), HttpPolicy(address)
    assert (policy.pictures, policy.picture_size) == (Echo.pictures, Echo.picture_size)
    observation = {
        "state": np.array([0.1], dtype=np.float32),
        "front": np.full((4, 6, 3), 255, dtype=np.uint8),
        "front_depth": np.zeros((4, 6, 1), dtype=np.float32),
    }
    policy.reset(told)
    expected = [np.float32(0.1), 255 * 72, *told.points[0, 0], 0, 0, 0]
    assert policy.act(observation).tolist() == [float(value) for value in expected]


def test_sessions_do_not_see_one_another(address):
    first, second = HttpPolicy(address), HttpPolicy(address)
    other = decode_start({**encode_start(start()), "points": encode_array(np.ones((1, 1, 3), dtype=np.float32))})
    first.reset(start())
    second.reset(other)
    seen = {"state": np.zeros(1, dtype=np.float32), "front": np.zeros((1, 1, 3), dtype=np.uint8)}
    assert first.act(seen)[2:5].tolist() == start().points[0, 0].tolist()
    assert second.act(seen)[2:5].tolist() == [1.0, 1.0, 1.0]


def test_an_error_of_the_policy_is_told_and_the_next_episode_goes_on(address):
    policy, bad = HttpPolicy(address), {**encode_start(start()), "seed": 13}
    with pytest.raises(
        PolicyError, match=r"/reset: status 500: ValueError: thirteen \(tests/\S+/test_http_policy\.py:\d+\)"
    ) as caught:
        policy.reset(decode_start(bad))
    assert caught.value.reason == "policy_error"
    policy.reset(start())


@pytest.mark.parametrize(
    "value",
    [
        None,
        [1, 2],
        {"type": "object", "shape": [1], "base64": ""},
        {"type": "float32", "shape": [10**12], "base64": ""},
        {"type": "float32", "shape": [-1], "base64": ""},
        {"type": "float32", "shape": [True], "base64": "AAAAAA=="},
        {"type": "float32", "shape": [1], "base64": "not base64!"},
        {"type": "float32", "shape": [1] * 9, "base64": "AAAAAA=="},
    ],
)
def test_what_is_no_array_is_refused(value):
    with pytest.raises(ValueError, match="array"):
        decode_array(value)


@pytest.mark.parametrize("kind", ["float32", "float64", "uint8"])
def test_arrays_come_back_equal(kind):
    array = (np.arange(24).reshape(2, 3, 4) * 1.7).astype(kind)
    again = decode_array(json.loads(json.dumps(encode_array(array))))
    assert np.array_equal(again, array)
    assert again.dtype == array.dtype


@pytest.mark.parametrize(
    "address", ["https://127.0.0.1:80", "http://example.com:80", "http://127.0.0.1", "http://127.0.0.1:9/x", "http://["]
)
def test_only_addresses_of_this_machine_are_asked(address):
    with pytest.raises(ConfigError, match="policy"):
        HttpPolicy(address)


def test_nobody_there_is_said():
    with pytest.raises(InputError, match="/describe: ConnectionRefusedError") as caught:
        HttpPolicy("http://127.0.0.1:9")
    assert caught.value.reason == "bad_policy"


def hostile(answers):
    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_POST(self):
            self.rfile.read(int(self.headers["Content-Length"]))
            body = answers[self.path]
            self.send_response(200)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_):
            pass

    return Handler


GOOD = b'{"pictures": [], "picture_size": [96, 128]}'


@pytest.mark.parametrize(
    ("answer", "problem"),
    [
        (b'{"pictures": ["../etc"], "picture_size": [96, 128]}', "no picture '../etc'"),
        (b'{"pictures": "front", "picture_size": [96, 128]}', "pictures 'front'"),
        (b'{"pictures": [], "picture_size": [1000000, 2]}', "picture_size"),
        (b"[]", "no object of JSON"),
        (b"<html>", "is no JSON"),
        (b"[" * 100_000, "is no JSON"),
        (b"x" * (MAX_ANSWER_BYTES + 1), "is longer than"),
    ],
)
def test_a_process_that_is_no_policy_is_refused(answer, problem):
    with serving(hostile({"/describe": answer})) as address, pytest.raises((InputError, ConfigError), match=problem):
        HttpPolicy(address)


@pytest.mark.parametrize(
    ("answer", "reason"),
    [
        (b'{"action": "all of them"}', "bad_action"),
        (b'{"action": [[0.0]]}', "bad_action"),
        (b'{"action": [true, null]}', "bad_action"),
        (b"{}", "bad_action"),
        (b"{", "policy_error"),
    ],
)
def test_hostile_actions_are_failures_of_the_policy(answer, reason):
    with serving(hostile({"/describe": GOOD, "/act": answer})) as address:
        policy = HttpPolicy(address)
        with pytest.raises(PolicyError) as caught:
            policy.act({"state": np.zeros(1, dtype=np.float32)})
        assert caught.value.reason == reason


def test_a_process_that_does_not_answer_is_given_up():
    class Silent(hostile({"/describe": GOOD, "/reset": b"{}"})):
        def parse_request(self) -> bool:
            parsed = super().parse_request()
            if self.path == "/reset":
                time.sleep(1.0)
            return parsed

    with serving(Silent) as address:
        policy = HttpPolicy(address, answer_s=0.1)
        with pytest.raises(PolicyError, match=r"no answer within 0\.1 s") as caught:
            policy.reset(start())
        assert caught.value.reason == "policy_timeout"


def test_a_server_that_ends_before_it_accepts_an_episode_is_gone():
    """Its backlog took the connection, which is reset with it: that is no failure in an episode."""
    answers = [("200 OK", json.dumps({"pictures": [], "picture_size": [4, 6]})), ("500 Failed", "{}")]
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def answer_twice_and_end():
            for status, body in answers:
                connection, _ = listener.accept()
                with connection:
                    connection.recv(65536)
                    head = f"HTTP/1.1 {status}\r\nContent-Length: {len(body)}\r\nConnection: close\r\n\r\n"
                    connection.sendall((head + body).encode())
            time.sleep(0.3)
            listener.close()

        thread = threading.Thread(target=answer_twice_and_end)
        thread.start()
        policy = HttpPolicy(f"http://127.0.0.1:{listener.getsockname()[1]}")
        with pytest.raises(PolicyError, match="status 500"):
            policy.reset(start())
        with pytest.raises(PolicyGoneError, match="start the policy again"):
            policy.reset(start())
        thread.join()


def test_a_page_of_a_browser_cannot_send_messages(address):
    for kind, status in (("text/plain", 500), ("application/json", 200)):
        connection = http.client.HTTPConnection(address.removeprefix("http://"))
        connection.request("POST", "/describe", "{}", {"Content-Type": kind})
        assert connection.getresponse().status == status
        connection.close()


SERVED = """
import sys, time
from tableverse_factory.evaluation.benchmark.policy_server import serve_policy
from tableverse_factory.evaluation.benchmark.random_policy import RandomPolicy

class Slow(RandomPolicy):
    def __init__(self):
        print("made", flush=True)
        time.sleep(float(sys.argv[1]))
        super().__init__()

serve_policy(Slow, port=int(sys.argv[2]))
print("over", flush=True)
"""


@pytest.mark.heavy
@pytest.mark.parametrize("serves", [pytest.param(False, marks=pytest.mark.slow), True])
def test_ctrl_c_ends_a_served_policy_without_a_word_also_while_it_is_made(serves):
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    process = subprocess.Popen(
        [sys.executable, "-c", SERVED, "0" if serves else "60", str(port)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),  # a background shell ignores it
    )
    assert process.stdout.readline() == "made\n"
    if serves:
        assert HttpPolicy(f"http://127.0.0.1:{port}").pictures == ()
    process.send_signal(signal.SIGINT)
    assert process.communicate(timeout=60) == ("over\n", "")
    assert process.returncode == 0
