"""The environment: by Gymnasium's own rules, judged as trajectories are, the same for the same seed."""

import copy
import subprocess
import sys
from itertools import chain, repeat

import gymnasium
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import tableverse_factory
from schemas.curation import Relation
from tableverse_factory import TableEnv, Variation, open_dataset
from tableverse_factory.core.errors import ConfigError, InputError
from tableverse_factory.delivery.episodes.pictures import PICTURES
from tableverse_factory.delivery.learning.reward import compute_goal_distance, compute_progress
from tableverse_factory.delivery.learning.variation import displace_objects

pytestmark = pytest.mark.heavy

ID = "TableVerse/PickPlace-v0"


@pytest.fixture(scope="module")
def scene(out):
    return open_dataset(out).scene("s-0")


def replayed(env, recording, seed=0):
    """What steps give when they are told what was recorded, and its last command for two seconds more."""
    env.reset(seed=seed)
    rewards = []
    for command in chain(recording.command[1:], repeat(recording.command[-1], 100)):
        observation, reward, terminated, truncated, info = env.step(env.command_to_action(command))
        rewards.append(reward)
        if terminated or truncated:
            break
    return observation, rewards, terminated, info


def test_gymnasium_finds_nothing_to_complain_about(out):
    """Its checker warns where it is not content, and warnings are errors here."""
    env = gymnasium.make(
        ID, dataset=str(out), scene="s-0", task="task_000", pictures=PICTURES[:6], picture_size=(48, 64)
    )
    check_env(env.unwrapped)
    assert env.unwrapped.sim.instruction == "Pick up the wooden block and place it next to the bowl"


def test_a_task_of_ones_own_is_worded_as_those_of_the_factory(scene):
    own = {"x_id": "obj_002", "y_id": "obj_001", "relation": "to the left of"}
    _, info = TableEnv(scene, own).reset(seed=0)
    assert info["instruction"] == "Pick up the tea box and place it to the left of the bowl"
    assert len(info["paraphrases"]) == 3
    assert TableEnv(scene, {**own, "instruction": "Tidy up"}).sim.instruction == "Tidy up"
    assert TableEnv(scene, {**own, "instruction": "  "}).sim.instruction == info["instruction"]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"instrution": "Tidy up"}, "'instrution' is no key: did you mean instruction"),
        ({"X_Id": "obj_000"}, "'X_Id' is no key: did you mean x_id"),
        ({"x_id": "obj_999"}, "x_id 'obj_999' is no object of s-0; there are obj_000, obj_001"),
        ({"y_id": "table"}, "y_id 'table' is no object"),
        ({"y_id": None}, "y_id None is no object"),
        ({"x_id": 0}, "x_id 0 is no object"),
        ({"instruction": 5}, "instruction 5: give text"),
        ({"relation": None}, "no relation 'None'; one of"),
    ],
)
def test_a_task_that_is_none_is_said_by_what_is_wrong(scene, change, said):
    with pytest.raises(InputError, match=said) as caught:
        TableEnv(scene, {"x_id": "obj_002", "y_id": "obj_001", "relation": "to the left of", **change})
    assert caught.value.reason == "bad_task"


def test_a_recorded_success_is_one_and_a_recorded_failure_is_none(scene):
    done, failed = scene.trajectories()
    env = TableEnv(scene, "task_000")
    assert np.allclose(env.sim.station.base.position, done.recording().base.position)
    _, rewards, terminated, info = replayed(env, done.recording())
    assert (terminated, info["success"], info["failure"]) == (True, True, "")
    assert (sum(rewards), rewards[-1]) == (1.0, 1.0)
    _, rewards, terminated, info = replayed(TableEnv(scene, "task_001"), failed.recording())
    assert (terminated, info["success"], info["lifted"], info["at_rest"]) == (False, False, True, True)
    assert sum(rewards) == 0.0


def test_a_gripper_that_never_closes_gets_nothing(scene):
    recording = scene.trajectory("task_000").recording()
    command = recording.command.copy()
    command[:, -1] = 0.07
    env = TableEnv(scene, "task_000", reward="dense")
    env.reset(seed=0)
    for row in command[1:]:
        _, _, terminated, _, info = env.step(env.command_to_action(row))
        assert not terminated
    assert not info["lifted"]


def test_dense_rewards_add_up_to_what_was_reached(scene):
    env = TableEnv(scene, "task_000", reward="dense")
    env.reset(seed=0)
    start = env.sim.reset(np.random.default_rng(0), Variation()).progress
    _, rewards, _, info = replayed(env, scene.trajectory("task_000").recording())
    assert info["success"]
    assert 1.0 < sum(rewards) <= 2.0 - start
    halves = np.add.reduceat(rewards, [0, len(rewards) // 2])
    assert halves[0] > 0.2, "what is on the way is told early"


@pytest.mark.parametrize(
    ("relation", "near", "far"),
    [
        (Relation.ON, (0.0, 0.0, 0.1), (0.2, 0.0, 0.1)),
        (Relation.LEFT, (-0.15, 0.0, 0.0), (0.15, 0.0, 0.0)),
        (Relation.RIGHT, (0.15, 0.0, 0.0), (-0.15, 0.0, 0.0)),
        (Relation.BEHIND, (0.0, 0.15, 0.0), (0.0, -0.15, 0.0)),
        (Relation.IN_FRONT, (0.0, -0.15, 0.0), (0.0, 0.15, 0.0)),
        (Relation.NEXT_TO, (0.1, 0.0, 0.0), (0.5, 0.0, 0.0)),
        (Relation.OUTSIDE, (0.3, 0.0, 0.0), (0.0, 0.0, 0.0)),
    ],
)
def test_the_way_is_shorter_where_the_relation_nearly_holds(relation, near, far):
    half = np.full(3, 0.05)
    ways = [compute_goal_distance(relation, np.array(place), np.zeros(3), half, half) for place in (near, far)]
    assert ways[0] < 1e-9 < 0.05 < ways[1]
    assert compute_progress(True, 2, 0.0, ways[0]) == pytest.approx(1.0)
    assert compute_progress(False, 2, 0.0, 9.0) == pytest.approx(0.5) == compute_progress(True, 0, 9.0, 99.0)


def test_the_same_seed_gives_the_same_bytes(scene):
    recording = scene.trajectory("task_000").recording()
    variation = Variation(position_m=0.004, yaw_rad=0.05)
    ends = []
    for seed in (5, 5, 6):
        env = TableEnv(scene, "task_000", variation=variation)
        observation, rewards, _, info = replayed(env, recording, seed)
        ends.append((observation["state"].tobytes(), observation["objects"].tobytes(), rewards, info))
    assert ends[0] == ends[1]
    assert ends[0] != ends[2]


def test_a_reset_is_the_scene_as_exported_unless_variation_is_asked_for(scene):
    env = TableEnv(scene, "task_000")
    exported = scene.model().qpos0.reshape(-1, 7)
    for seed in (0, 1):
        observation, _ = env.reset(seed=seed)
        assert np.array_equal(observation["objects"], exported.astype(np.float32))
    rows = []
    for seed in range(8):
        moved, _ = env.reset(seed=seed, options={"variation": Variation(position_m=0.05, yaw_rad=0.5)})
        rows.append(moved["objects"])
        away = np.abs(moved["objects"] - exported)
        assert away[:, :2].max() < 0.08
        assert away[:, 2].max() < 1e-6, "it stays on the table"
        for _ in range(25):
            moved, _, terminated, _, info = env.step(env.command_to_action([*env.sim.station.arm.home, 0.05]))
        assert not terminated
        assert info["disturbed_m"] < 5e-4, "and nothing was put into anything"
    assert min(np.abs(a - b).max() for k, a in enumerate(rows) for b in rows[:k]) > 0.005
    assert np.array_equal(env.reset(seed=9)[0]["objects"], exported.astype(np.float32)), "once"


def test_wide_moves_leave_everything_standing_on_the_table(scene):
    env = TableEnv(scene, "task_000")
    half = scene.model().geom("table").size[:2]
    exported, _ = env.reset(seed=0)
    waiting = env.command_to_action([*env.sim.station.arm.home, 0.05])
    farthest = 0.0
    for seed in range(12):
        moved, _ = env.reset(seed=seed, options={"variation": Variation(position_m=0.25, yaw_rad=0.5)})
        away = np.abs(moved["objects"] - exported["objects"])[:, :2]
        farthest = max(farthest, float(away.max()))
        assert (np.abs(moved["objects"][:, :2]) < half).all()
        for _ in range(25):
            _, _, terminated, _, info = env.step(waiting)
        assert (terminated, info["failure"]) == (False, "")
    assert farthest > 0.15


def test_places_that_were_tried_leave_no_trace(scene):
    """A place that is taken may fill MuJoCo's memory: its warning would end the episode as unstable."""
    station = TableEnv(scene, "task_000").sim.station
    data = station.data()
    mujoco.mj_forward(station.model, data)
    before = copy.copy(data)
    displace_objects(station, data, Variation(position_m=0.25), np.random.default_rng(0))
    assert np.abs(data.qpos - before.qpos).max() > 0.05
    assert np.array_equal(data.contact.pos, before.contact.pos)
    assert np.array_equal(data.xpos, before.xpos)


def test_looks_change_pictures_and_nothing_else(scene):
    env = TableEnv(scene, "task_000", pictures=("front",), picture_size=(60, 80))
    plain, _ = env.reset(seed=1)
    seen = [env.reset(seed=s, options={"variation": Variation(table=True, lights=True)})[0] for s in (1, 1, 2)]
    assert np.array_equal(seen[0]["front"], seen[1]["front"])
    for one, other in ((plain, seen[0]), (seen[0], seen[2])):
        assert np.abs(one["front"].astype(int) - other["front"]).mean() > 2
        assert np.array_equal(one["objects"], other["objects"])
    assert np.array_equal(env.reset(seed=1)[0]["front"], plain["front"])


def test_displaced_cameras_change_all_pictures_a_little_and_nothing_else(scene):
    env = TableEnv(scene, "task_000", pictures=("front", "wrist", "front_depth"), picture_size=(60, 80))
    plain, _ = env.reset(seed=1)
    seen = [env.reset(seed=s, options={"variation": Variation(cameras=True)})[0] for s in (1, 1, 2)]
    for name in ("front", "wrist", "front_depth"):
        assert np.array_equal(seen[0][name], seen[1][name])
        assert not np.array_equal(seen[0][name], seen[2][name])
        assert not np.array_equal(seen[0][name], plain[name])
    for other in seen:
        both = (plain["front_depth"] > 0) & (other["front_depth"] > 0)
        assert 0.001 < np.abs(plain["front_depth"] - other["front_depth"])[both].mean() < 0.2
        assert np.array_equal(plain["objects"], other["objects"])
    assert np.array_equal(env.reset(seed=1)[0]["wrist"], plain["wrist"])


def test_friction_changes_within_its_bounds_for_one_episode(scene):
    env = TableEnv(scene, "task_000")
    model, body = env.sim.station.model, env.sim.station.object_bodies[env.sim.goal.x_id]
    touched = np.concatenate([np.flatnonzero(model.geom_bodyid == body), env.sim.station.finger_geoms])
    own, factors = model.geom_friction.copy(), []
    for seed in range(12):
        env.reset(seed=seed, options={"variation": Variation(friction=2.0)})
        factor = model.geom_friction / own
        factors.append(factor[touched[0], 0])
        assert np.allclose(factor[touched][:, :2], factors[-1])
        assert np.allclose(factor[touched][:, 2], 1.0)
        assert np.allclose(np.delete(factor, touched, axis=0), 1.0)
    assert 0.5 <= min(factors) < 0.8
    assert 1.25 < max(factors) <= 2.0
    env.reset(seed=0)
    assert np.array_equal(model.geom_friction, own)
    for factor in (0.5, 11.0, float("nan")):
        with pytest.raises(ConfigError, match="friction"):
            Variation(friction=factor)


def test_pictures_follow_what_happens(scene):
    env = TableEnv(scene, "task_000", render_mode="rgb_array", render_size=(60, 80))
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.render()
    env.reset(seed=0)
    before = env.render()
    for command in scene.trajectory("task_000").recording().command[1:60]:
        env.step(env.command_to_action(command))
    after = env.render()
    assert before.shape == after.shape == (60, 80, 3)
    assert np.abs(before.astype(int) - after).max() > 60


def test_an_episode_ends_when_it_cannot_succeed_or_takes_too_long(scene):
    recording, base = scene.trajectory("task_000").recording(), TableEnv(scene, "task_000").sim.station.base
    env = TableEnv(scene, {"x_id": "obj_001", "y_id": "obj_002", "relation": "next to"}, base=base)
    _, rewards, terminated, info = replayed(env, recording)
    assert (sum(rewards), terminated, info["failure"]) == (0.0, True, "disturbed"), "the block was none of its business"
    assert 0.02 < info["disturbed_m"] < 0.03
    patient = TableEnv(scene, {"x_id": "obj_001", "y_id": "obj_002", "relation": "on"}, base=base, max_disturbed_m=1.0)
    _, _, terminated, info = replayed(patient, recording)
    assert (terminated, info["success"], info["failure"]) == (False, False, "")
    env = TableEnv(scene, "task_000", max_steps=3)
    env.reset(seed=0)
    rest = env.command_to_action([*env.sim.station.arm.home, 0.05])
    assert [env.step(rest)[2:4] for _ in range(3)] == [(False, False), (False, False), (False, True)]


def test_actions_and_commands_are_the_same_said_twice(scene):
    env = TableEnv(scene, "task_000")
    command = scene.trajectory("task_000").recording().command
    for row in command[::40]:
        assert np.abs(env.action_to_command(env.command_to_action(row)) - row).max() < 1e-6
    arm = env.sim.station.arm
    assert np.allclose(env.action_to_command(np.full(8, -3.0)), [*arm.lower, 0.0])
    assert np.allclose(env.action_to_command(np.ones(8)), [*arm.upper, arm.max_opening_m])


@pytest.mark.parametrize(
    "wrong", [0.5, np.zeros(1), np.zeros((1, 8)), np.zeros(9), np.full(8, np.nan), np.array([np.inf] * 8)]
)
def test_what_is_no_action_is_refused(scene, wrong):
    env = TableEnv(scene, "task_000")
    env.reset(seed=0)
    with pytest.raises(InputError, match=r"action .*: give finite numbers, shape \(8,\)"):
        env.step(wrong)
    with pytest.raises(InputError, match="command "):
        env.command_to_action(wrong)


def test_an_episode_that_has_ended_pays_nothing_more(scene):
    env = TableEnv(scene, "task_000", render_mode="rgb_array", render_size=(48, 64))
    _, _, terminated, _ = replayed(env, scene.trajectory("task_000").recording())
    assert terminated
    with pytest.raises(gymnasium.error.ResetNeeded, match="has ended"):
        env.step(np.zeros(8))
    assert env.render().shape == (48, 64, 3), "but its end is seen"
    env.reset(seed=0)
    env.step(np.zeros(8))
    short = TableEnv(scene, "task_000", max_steps=1)
    short.reset(seed=0)
    assert short.step(np.zeros(8))[3]
    with pytest.raises(gymnasium.error.ResetNeeded, match="has ended"):
        short.step(np.zeros(8))


def test_gymnasium_knows_how_long_an_episode_may_be(out):
    names = {"dataset": str(out), "scene": "s-0", "task": "task_000"}
    assert gymnasium.make(ID, **names).spec.max_episode_steps == 1000
    short = gymnasium.make(ID, **names, max_episode_steps=2)
    short.reset(seed=0)
    assert [short.step(np.zeros(8, np.float32))[3] for _ in range(2)] == [False, True]
    with pytest.raises(ConfigError, match=r"max_steps 3: gymnasium\.make has max_episode_steps"):
        gymnasium.make(ID, **names, max_steps=3)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"max_steps": -5}, "max_steps -5: give a whole number from 1 on"),
        ({"max_objects": 0}, "max_objects 0: give a whole number from 3 on"),
        ({"max_disturbed_m": -1.0}, "max_disturbed_m -1.0: give a length"),
        ({"max_disturbed_m": float("nan")}, "max_disturbed_m nan: give a length"),
        ({"picture_size": (0, 0)}, r"picture_size \(0, 0\): give height and width, each from 1 to 4096 px"),
        ({"picture_size": (48,)}, r"picture_size \(48,\): give height and width"),
        ({"pictures": ("front", "side")}, "no picture 'side'; there are front, front_depth, front_instances, wrist"),
        ({"render_size": 48}, "render_size 48: give height and width"),
        ({"variation": {"position_m": 0.1}}, "variation {'position_m': 0.1}: give a Variation"),
    ],
)
def test_an_argument_that_is_none_is_said(scene, wrong, said):
    with pytest.raises(ConfigError, match=said):
        TableEnv(scene, "task_000", **wrong)


def test_an_option_that_is_none_is_said(scene):
    with pytest.raises(InputError, match="task None: give an id, or x_id, y_id and relation"):
        TableEnv(scene, None)
    env = TableEnv(scene, "task_000")
    with pytest.raises(ConfigError, match="no option 'variaton'; there is 'variation'"):
        env.reset(options={"variaton": Variation()})
    with pytest.raises(ConfigError, match=r"variation 0\.1: give a Variation"):
        env.reset(options={"variation": 0.1})


def test_environments_of_several_scenes_run_together(out):
    def make(scene):
        return lambda: gymnasium.make(ID, dataset=str(out), scene=scene, task="task_000", max_objects=5)

    finals = []
    for vector in (gymnasium.vector.SyncVectorEnv, gymnasium.vector.AsyncVectorEnv):
        envs = vector([make("s-0"), make("s-1")])
        envs.reset(seed=3)
        envs.action_space.seed(3)
        for _ in range(5):
            observation, rewards, *_ = envs.step(envs.action_space.sample())
        envs.close()
        assert rewards.shape == (2,)
        assert observation["objects"].shape == (2, 5, 7)
        assert (observation["objects"][:, 3:] == 0).all()
        finals.append(observation)
    assert all(np.array_equal(finals[0][key], finals[1][key]) for key in finals[0])
    assert not np.array_equal(finals[0]["objects"][0], finals[0]["objects"][1])


def test_tasks_of_ones_own_and_tasks_that_are_none(scene):
    env = TableEnv(scene, {"x_id": "obj_002", "y_id": "obj_001", "relation": "on"})
    assert env.sim.object_ids == ("obj_002", "obj_001", "obj_000")
    assert env.observation_space.contains(env.reset(seed=0)[0])
    with pytest.raises(InputError, match="has no task 'task_009'; there are: task_000, task_001, task_002"):
        TableEnv(scene, "task_009")
    with pytest.raises(InputError, match="no relation 'over'"):
        TableEnv(scene, {"x_id": "obj_000", "y_id": "obj_001", "relation": "over"})
    for wrong in ({"reward": "shaped"}, {"render_mode": "human"}, {"max_objects": 2}, {"robot": "pandora"}):
        with pytest.raises(ConfigError):
            TableEnv(scene, "task_000", **wrong)


def test_without_its_package_it_says_what_to_type(monkeypatch):
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    monkeypatch.delitem(sys.modules, "tableverse_factory.delivery.learning.environment")
    with pytest.raises(ConfigError, match=r"TableEnv needs gymnasium: pip install 'tableverse-factory\[gym\]'"):
        _ = tableverse_factory.TableEnv


def test_names_alone_are_enough_for_a_process_that_knows_nothing(out):
    code = (
        "import sys, gymnasium\n"
        "env = gymnasium.make(sys.argv[1], dataset=sys.argv[2], scene='s-1', task='task_000')\n"
        "again = gymnasium.make(gymnasium.envs.registration.EnvSpec.from_json(env.spec.to_json()))\n"
        "print((env.reset(seed=1)[0]['state'] == again.reset(seed=1)[0]['state']).all())\n"
    )
    name = f"tableverse_factory.gym:{ID}"
    done = subprocess.run([sys.executable, "-c", code, name, str(out)], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.strip()) == (0, "True"), done.stderr[-2000:]
