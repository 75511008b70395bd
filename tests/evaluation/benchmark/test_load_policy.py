"""Policies by name: what is wrong with a name or a class is said in one line."""

import shutil

import numpy as np
import pytest

from tableverse_factory.core.errors import ConfigError, InputError
from tableverse_factory.evaluation.benchmark.load_policy import PolicyName, load_policy
from tableverse_factory.evaluation.benchmark.policy import PolicyError, check_action, sample_points
from tests.helpers.simple_scenes import box

CLASSES = """
class Good:
    pictures, picture_size = ("wrist",), (48, 64)
    def __init__(self, weights=None):
        self.weights = weights
    def reset(self, start): pass
    def act(self, observation): pass

class Deaf(Good):
    reset = None

class Blind(Good):
    pictures = ("infrared",)

class Listed(Good):
    pictures = "front"

class Huge(Good):
    picture_size = (100000, 2)
"""


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "classes.py"
    path.write_text(CLASSES)
    return path


def test_a_class_of_a_file_gets_its_weights(file):
    assert load_policy(PolicyName(f"{file}:Good", "weights.pt")).weights == "weights.pt"
    assert load_policy(PolicyName(f"{file}:Good")).weights is None
    module = "tableverse_factory.evaluation.benchmark.random_policy:RandomPolicy"
    assert load_policy(PolicyName(module)).pictures == ()


def test_the_policy_that_replays_says_that_it_needs_a_dataset():
    with pytest.raises(ConfigError, match="as --weights"):
        load_policy(PolicyName("replay"))


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        ("Deaf", "has no method `reset`"),
        ("Blind", "no picture 'infrared'"),
        ("Listed", "pictures 'front': give a tuple"),
        ("Huge", "picture_size .* each from 1 to"),
        ("Nobody", "there is no class Nobody"),
    ],
)
def test_what_is_no_policy_is_said(file, name, problem):
    with pytest.raises((InputError, ConfigError), match=problem):
        load_policy(PolicyName(f"{file}:{name}"))


@pytest.mark.parametrize("name", ["", "best", "a:b:", "module:not a name", ":Class"])
def test_other_names_are_refused_with_those_that_there_are(name):
    with pytest.raises(ConfigError, match="give planner, replay, random, state, picture, module:Class"):
        load_policy(PolicyName(name))


def test_a_file_that_fails_is_no_traceback(tmp_path):
    path = tmp_path / "broken_policy.py"
    path.write_text("1 / 0")
    with pytest.raises(InputError, match="does not load: ZeroDivisionError: division by zero"):
        load_policy(PolicyName(f"{path}:Policy"))
    with pytest.raises(InputError, match=r"absent\.py is no file"):
        load_policy(PolicyName(f"{tmp_path}/absent.py:Policy"))
    with pytest.raises(InputError, match="No module named 'no_such_module'"):
        load_policy(PolicyName("no_such_module:Policy"))


def test_other_code_or_weights_are_another_policy(file, tmp_path):
    weights = tmp_path / "weights.pt"
    weights.write_bytes(b"1")
    digests = [PolicyName(f"{file}:Good", str(weights)).identify()[0]]
    weights.write_bytes(b"2")
    digests.append(PolicyName(f"{file}:Good", str(weights)).identify()[0])
    file.write_text(CLASSES + "\n")
    digests.append(PolicyName(f"{file}:Good", str(weights)).identify()[0])
    assert len(set(digests)) == 3
    for content in (b"3", b"4"):
        (tmp_path / "folder/part").mkdir(parents=True, exist_ok=True)
        (tmp_path / "folder/part/weights.pt").write_bytes(content)
        digests.append(PolicyName(f"{file}:Good", str(tmp_path / "folder")).identify()[0])
    assert len(set(digests)) == 5
    shutil.copytree(tmp_path / "folder", tmp_path / "moved")
    assert PolicyName(f"{file}:Good", str(tmp_path / "moved")).identify()[0] == digests[-1]
    (tmp_path / "moved/part/weights.pt").rename(tmp_path / "moved/part/others.pt")
    assert PolicyName(f"{file}:Good", str(tmp_path / "moved")).identify()[0] != digests[-1]
    assert PolicyName(f"{file}:Good").shown == "classes.py:Good"
    assert PolicyName(f"{file}:Good", title="good\x1b[2J").shown == "good\\x1b[2J"


def test_other_code_of_a_module_is_another_policy(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    file = tmp_path / "policies_of_a_package.py"
    file.write_text(CLASSES)
    before = PolicyName("policies_of_a_package:Good").identify()[0]
    file.write_text(CLASSES + "\n")
    assert PolicyName("policies_of_a_package:Good").identify()[0] != before
    assert PolicyName("absent_module:Good").identify()[0] != PolicyName("http://127.0.0.1:1").identify()[0]


def test_actions_are_checked_and_clipped():
    assert check_action([2.0, -3.0, 0.5], 3).tolist() == [1.0, -1.0, 0.5]
    for bad in ([0.0, 0.0], [[0.0] * 3], [0.0, float("nan"), 0.0], "abc", [1.0, None, 2.0], {"action": 1}):
        with pytest.raises(PolicyError) as caught:
            check_action(bad, 3)
        assert caught.value.reason == "bad_action"
        assert "\n" not in str(caught.value)


def test_points_lie_on_the_surface_and_spread_by_area():
    mesh = box(0.2, 0.1, 0.02)
    points = sample_points(mesh, 4000, np.random.default_rng(0))
    half = np.array([0.1, 0.05, 0.01])
    assert (np.abs(points) <= half + 1e-6).all()
    assert np.abs(np.abs(points) - half).min(axis=1).max() < 1e-6
    top = np.isclose(points[:, 2], 0.01, atol=1e-6).mean()
    assert top == pytest.approx(0.02 / (2 * (0.02 + 0.004 + 0.002)), abs=0.03)
    assert np.array_equal(points, sample_points(mesh, 4000, np.random.default_rng(0)))
