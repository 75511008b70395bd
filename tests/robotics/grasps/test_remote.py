"""The client of a grasp server, against a real server: frames, what is kept, and everything that may go wrong."""

import json
import re
import threading
from http.server import ThreadingHTTPServer

import numpy as np
import pytest

from schemas.config import TrajectoriesConfig
from schemas.geometry import Pose
from tableverse_factory.core.errors import AnswerInvalidError, ModelAccessError, ModelError
from tableverse_factory.geometry.math.transforms import quaternion_about_z
from tableverse_factory.geometry.mesh.meshes import place_mesh
from tableverse_factory.models.remote.endpoint import MAX_BODY_BYTES
from tableverse_factory.models.services import Services
from tableverse_factory.robotics.grasps.closing import close_grasps
from tableverse_factory.robotics.grasps.remote import COUNT, FORMAT, MAX_COUNT, POINTS, request_grasps
from tests.helpers.model_server import Scripted
from tests.helpers.paths import ROOT
from tests.helpers.simple_bodies import box

BODY = place_mesh(box(0.05, 0.03, 0.12), Pose(np.array([0.2, -0.1, 0.0]), quaternion_about_z(0.4)))
DEPTH_M = 0.1034


def from_above(x=0.0, y=0.0, z=0.0) -> list[list[float]]:
    """A gripper base above the centroid that looks down, its x (closing) along the body's narrow side."""
    closing = np.array([-np.sin(0.4), np.cos(0.4), 0.0])
    approach = np.array([0.0, 0.0, -1.0])
    matrix = np.eye(4)
    matrix[:3, :3] = np.column_stack([closing, np.cross(approach, closing), approach])
    matrix[:3, 3] = [x, y, z + DEPTH_M]
    return matrix.tolist()


def answer(*poses, scores=None) -> Scripted:
    return Scripted({"grasps": list(poses), "scores": [0.5] * len(poses) if scores is None else scores})


@pytest.fixture
def put(server, tmp_path):
    def ask_it(**options):
        config = TrajectoriesConfig(
            grasp_model="graspgen",
            grasp_url=server.url,
            **{"grasp_timeout_s": 5.0, "grasp_depth_m": DEPTH_M, **options},
        )
        return request_grasps(BODY, config, Services(tmp_path))

    return ask_it


def test_the_server_gets_a_cloud_about_its_centroid(put, server):
    server.say(answer(from_above()))
    put()
    (asked,) = server.asked
    assert server.paths == ["/v1/grasps"]
    assert {"format": FORMAT, "gripper": "franka_panda", "count": COUNT}.items() <= asked.items()
    points = np.array(asked["points"])
    assert points.shape == (POINTS, 3)
    assert np.abs(points.mean(axis=0)).max() < 1e-6
    lengths = np.linalg.norm(points, axis=1)
    assert lengths.max() < np.linalg.norm([0.025, 0.015, 0.06]) + 1e-3


def test_their_frames_become_ours(put, server, arm):
    server.say(answer(from_above(z=0.02), scores=[7.5]))
    found = put()
    assert np.abs(found.rotations[0, :, 2] - [0.0, 0.0, -1.0]).max() < 1e-12
    assert np.abs(found.rotations[0, :, 1] - [-np.sin(0.4), np.cos(0.4), 0.0]).max() < 1e-12
    assert np.linalg.det(found.rotations[0]) == pytest.approx(1.0)
    assert np.abs(found.positions[0] - [0.2, -0.1, 0.08]).max() < 1e-3
    assert found.scores.tolist() == [7.5]
    held = close_grasps(found, BODY, arm.shape, arm.max_opening_m)
    assert held.widths[0] == pytest.approx(0.03, abs=1e-6)


@pytest.mark.heavy
def test_grasps_are_moved_to_where_both_fingers_touch_and_empty_ones_are_left_out(put, server, arm):
    sideways = np.array([-np.sin(0.4), np.cos(0.4)]) * 0.01
    server.say(answer(from_above(*sideways), from_above(z=0.2), from_above(x=0.04)))
    held = close_grasps(put(), BODY, arm.shape, arm.max_opening_m)
    assert len(held) == 1
    assert np.abs(held.positions[0, :2] - [0.2, -0.1]).max() < 1e-3


def test_an_answer_is_asked_for_once(put, server):
    server.say(answer(from_above()))
    first = put()
    server.say(Scripted(b"", status=500))
    again = put()
    assert server.asked == []
    assert first.positions.tobytes() == again.positions.tobytes()


def test_no_grasps_are_an_answer(put, server, arm):
    server.say(answer())
    assert len(close_grasps(put(), BODY, arm.shape, arm.max_opening_m)) == 0


def test_tiny_errors_of_rotations_are_repaired(put, server):
    rough = np.array(from_above())
    rough[:3, :3] *= 1.002
    server.say(answer(rough.tolist()))
    rotation = put().rotations[0]
    assert np.abs(rotation.T @ rotation - np.eye(3)).max() < 1e-12


def changed(row, column, value):
    pose = from_above()
    pose[row][column] = value
    return answer(pose)


MIRRORED = (np.array(from_above()) @ np.diag([-1.0, 1.0, 1.0, 1.0])).tolist()
NONSENSE = {
    "nan": Scripted(json.dumps({"grasps": [from_above()], "scores": [float("nan")]}).encode()),
    "infinite": Scripted(b'{"grasps": [[[1,0,0,1e999],[0,1,0,0],[0,0,1,0],[0,0,0,1]]], "scores": [1]}'),
    "far": changed(0, 3, 1e6),
    "scaled": answer((2.0 * np.array(from_above())).tolist()),
    "sheared": changed(0, 0, 3.0),
    "mirrored": answer(MIRRORED),
    "no rotation": answer(np.zeros((4, 4)).tolist()),
    "transposed": answer(np.array(from_above()).T.tolist()),
    "wrong shape": answer([[1.0, 0.0, 0.0]]),
    "ragged": answer([[1.0, 0.0], [0.0]]),
    "more scores": answer(from_above(), scores=[0.5, 0.6]),
    "text": answer(from_above(), scores=["good"]),
    "huge integers": Scripted(b'{"grasps": [], "scores": [1' + b"0" * 400 + b"]}"),
    "a huge integer among numbers": Scripted(b'{"grasps": [], "scores": [0.5, 1' + b"0" * 400 + b"]}"),
    "null": answer(from_above(), scores=[None]),
    "no scores": Scripted({"grasps": [from_above()]}),
    "an object": Scripted({"grasps": {"0": from_above()}, "scores": [1.0]}),
    "too many": Scripted({"grasps": [from_above()] * (MAX_COUNT + 1), "scores": [0.0] * (MAX_COUNT + 1)}),
}


@pytest.mark.heavy
@pytest.mark.parametrize("name", NONSENSE)
def test_nonsense_is_refused_and_not_kept(put, server, name):
    server.say(NONSENSE[name])
    with pytest.raises(AnswerInvalidError, match="the grasp server answers"):
        put()
    server.say(answer(from_above()))
    assert len(put()) == 1


@pytest.mark.heavy
@pytest.mark.parametrize("status", [429, 500, 503])
def test_what_may_pass_is_asked_again(put, server, status):
    server.say(Scripted(b"", status=status, headers={"Retry-After": "0"}), answer(from_above()))
    assert len(put()) == 1
    assert len(server.asked) == 2


@pytest.mark.heavy
@pytest.mark.parametrize("body", [b'{"grasps": [[[1, 0', b"", b"[]", b"\xff\xfe"])
def test_broken_json_is_asked_again(put, server, body):
    server.say(Scripted(body, headers={"Retry-After": "0"}), answer(from_above()))
    assert len(put()) == 1


@pytest.mark.heavy
def test_an_answer_that_breaks_off_is_asked_again(put, server):
    def cut(handler):
        handler.send_response(200)
        handler.send_header("Content-Length", "100000")
        handler.send_header("Retry-After", "0")
        handler.end_headers()
        handler.wfile.write(b'{"grasps": [')

    server.say(Scripted(write=cut), answer(from_above()))
    assert len(put()) == 1


@pytest.mark.heavy
def test_a_slow_server_is_given_up(put, server):
    given_up = threading.Event()
    server.say(Scripted(write=lambda handler: given_up.wait(60.0)))
    with pytest.raises(ModelError, match=r"within|in time"):
        put(grasp_timeout_s=0.5)
    given_up.set()


@pytest.mark.parametrize(("status", "error"), [(401, ModelAccessError), (404, ModelAccessError), (400, ModelError)])
def test_what_cannot_pass_is_not_asked_again(put, server, status, error):
    server.say(Scripted({"error": "no"}, status=status))
    with pytest.raises(error):
        put()
    assert len(server.asked) == 1


def test_endless_answers_are_cut(put, server):
    server.say(Scripted(b" " * (MAX_BODY_BYTES + 1)))
    with pytest.raises(ModelError, match="longer"):
        put()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({}, "grasp_url"),
        ({"grasp_url": "http://grasps.example"}, "https"),
        ({"grasp_url": "http://localhost:1", "grasp_timeout_s": 60.0}, "task_deadline_s"),
    ],
)
def test_a_configuration_that_cannot_work_is_refused(options, words):
    with pytest.raises(ValueError, match=words):
        TrajectoriesConfig(grasp_model="graspgen", **options)


@pytest.mark.heavy
def test_the_bridge_of_the_docs_is_understood(tmp_path):
    page = (ROOT / "docs" / "trajectories.md").read_text()
    (code,) = [block for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "class Bridge" in block]
    code = code.replace("raise NotImplementedError", "return POSES, [0.5] * len(POSES)").rpartition("Threading")[0]
    names = {"POSES": [from_above()]}
    exec(compile(code, "docs/trajectories.md", "exec"), names)  # noqa: S102
    names["Bridge"].log_message = lambda *args: None
    bridge = ThreadingHTTPServer(("127.0.0.1", 0), names["Bridge"])
    threading.Thread(target=bridge.serve_forever, daemon=True).start()
    try:
        url = f"http://127.0.0.1:{bridge.server_port}"
        found = request_grasps(BODY, TrajectoriesConfig(grasp_model="graspgen", grasp_url=url), Services(tmp_path))
    finally:
        bridge.shutdown()
        bridge.server_close()
    assert np.abs(found.positions[0] - [0.2, -0.1, 0.06]).max() < 1e-3
