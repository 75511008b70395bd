"""Motions in real physics: what is good succeeds; what is spoilt in one way fails for exactly that reason."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from schemas.curation import Relation
from schemas.geometry import Pose
from schemas.trajectories import Phase
from tableverse_factory.core.errors import InputError
from tableverse_factory.robotics.execution import rollout
from tableverse_factory.robotics.execution.arrays import MAX_DURATION_S, decode_recording, encode_recording
from tableverse_factory.robotics.execution.execute import MAX_SETTLE_S, RolloutResult, execute_and_check
from tableverse_factory.robotics.execution.goal import load_goal
from tableverse_factory.robotics.execution.perturbations import (
    PERTURBATIONS,
    find_survived_perturbations,
    perturb_station,
)
from tableverse_factory.robotics.execution.rollout import Rollout, build_commands
from tableverse_factory.robotics.robots.panda import GRIP_FORCE_N
from tableverse_factory.robotics.robots.registry import load_arm
from tableverse_factory.robotics.robots.station import Station
from tests.helpers.pick_recording import (
    BASE,
    BESIDE,
    BLOCK,
    BYSTANDER,
    REFERENCE,
    STEP_S,
    goal,
    pick_and_place,
    scene_files,
    station,
)

pytestmark = pytest.mark.heavy


@pytest.fixture(scope="module")
def good() -> RolloutResult:
    return execute_and_check(station(), BASE, pick_and_place(), goal())


def speed_at_the_end(proof: RolloutResult) -> float:
    """Of the object, over the last two samples [m/s]."""
    before, last = proof.recording.object_pose[-2:, :3].astype(np.float64)
    return float(np.linalg.norm(last - before)) / STEP_S


def test_a_good_motion_succeeds(good: RolloutResult) -> None:
    verdict = good.verdict
    assert (verdict.success, verdict.failed_phase, verdict.reason, verdict.detail) == (True, "", "", "")
    assert verdict.lifted_m == pytest.approx(0.16, abs=0.01)
    assert verdict.disturbed_m < 1e-4
    assert speed_at_the_end(good) < 1e-3


def test_what_is_recorded_is_what_was_told_and_what_happened(good: RolloutResult) -> None:
    recording, motion = good.recording, pick_and_place()
    told = len(motion.positions)
    assert np.array_equal(recording.command[:told], np.column_stack([motion.positions, motion.openings]))
    assert np.array_equal(
        recording.command[told:], np.repeat(recording.command[told - 1][None], len(recording) - told, 0)
    )
    assert np.array_equal(recording.time_s, (np.arange(len(recording)) * STEP_S).astype(np.float32))
    assert np.abs(recording.qpos[-1, :7] - motion.positions[-1]).max() < 1e-3
    assert np.linalg.norm(recording.object_pose[-1, :3] - np.array(BESIDE)) < 0.005
    held = recording.phase == list(Phase).index(Phase.PRE_PLACE)
    assert (recording.pads[held] == 3).all()
    apart = np.linalg.norm(recording.object_pose[held, :3] - recording.tcp[held, :3], axis=1)
    assert np.ptp(apart) < 1e-3, "the object goes with the gripper"


def test_the_arm_is_moved_by_its_servos_alone(good: RolloutResult) -> None:
    """Nothing jumps: positions are the integral of speeds, and no servo pulls harder than its limit."""
    recording = good.recording
    steps = np.diff(recording.qpos.astype(np.float64), axis=0)
    between = (recording.qvel[1:].astype(np.float64) + recording.qvel[:-1]) / 2 * STEP_S
    assert np.abs(steps - between)[:, :7].max() < 1e-3
    jumps = np.linalg.norm(np.diff(recording.object_pose[:, :3].astype(np.float64), axis=0), axis=1)
    assert jumps.max() < 1.0 * STEP_S, "the object is nowhere faster than 1 m/s"
    assert not station().model.neq or (station().model.eq_type != mujoco.mjtEq.mjEQ_WELD).all()


def test_the_same_again_gives_the_same_bytes(good: RolloutResult) -> None:
    motion = pick_and_place()
    station().place_base(Pose(np.array([0.3, -0.4, 0.0]), BASE.quaternion_wxyz))
    again = execute_and_check(station(), BASE, motion, goal())
    assert again.verdict == good.verdict
    assert encode_recording(again.recording) == encode_recording(good.recording)


def test_an_open_gripper_grasps_nothing() -> None:
    proof = execute_and_check(station(), BASE, pick_and_place(closed=0.06), goal())
    assert (proof.verdict.failed_phase, proof.verdict.reason) == ("grasp", "not_grasped")
    assert len(proof.recording) == build_commands(pick_and_place()).last_of(Phase.GRASP) + 1, (
        "it ends where it is certain"
    )


@pytest.mark.parametrize(("share", "reason"), [(1.5, ""), (0.7, "slipped")])
def test_what_is_slippery_slips(share: float, reason: str) -> None:
    """Two pads that press with F hold a mass m as long as 2 µ F > m g."""
    slippery = perturb_station(station(), "friction_doubled", BLOCK)
    weight = 9.81 * slippery.model.body_mass[slippery.object_bodies[BLOCK]]
    slippery.model.geom_friction[slippery.finger_geoms, :2] = share * weight / (2 * GRIP_FORCE_N)
    verdict = execute_and_check(slippery, BASE, pick_and_place(), goal()).verdict
    assert verdict.reason == reason
    assert not reason or (verdict.failed_phase == "post_grasp" and "mm of at least 30 mm" in verdict.detail)


def test_a_gripper_that_opens_too_early_drops() -> None:
    motion = pick_and_place()
    openings = np.array(motion.openings)
    early = np.flatnonzero(motion.phases == list(Phase).index(Phase.PRE_PLACE))[10]
    openings[early:] = 0.07
    verdict = execute_and_check(station(), BASE, replace(motion, openings=openings), goal()).verdict
    assert (verdict.failed_phase, verdict.reason) == ("pre_place", "dropped")
    assert "no finger touched it for 0.06 s" in verdict.detail


def test_what_is_too_heavy_slips() -> None:
    heavy = perturb_station(station(), "mass_plus_30", BLOCK)
    grow, _ = PERTURBATIONS["mass_plus_30"]
    grow(heavy, heavy.object_bodies[BLOCK], 30.0)
    assert execute_and_check(heavy, BASE, pick_and_place(), goal()).verdict.reason == "slipped"


def test_what_stands_in_the_way_is_disturbed() -> None:
    there = (0.04, 0.05, 0.05)
    motion = pick_and_place(over=(0.0, 0.06, 0.06))
    verdict = execute_and_check(station(there), BASE, motion, goal()).verdict
    assert (verdict.success, verdict.reason) == (False, "disturbed")
    assert "obj_002" in verdict.detail
    assert verdict.disturbed_m > 0.02


def test_a_wrong_place_misses_the_relation() -> None:
    verdict = execute_and_check(station(), BASE, pick_and_place(place=(-0.15, 0.1, 0.03)), goal()).verdict
    assert (verdict.failed_phase, verdict.reason) == ("place", "relation_missed")
    assert f"{BLOCK} is not next to {REFERENCE}" in verdict.detail


@pytest.mark.parametrize(
    ("place", "relation", "success"),
    [
        ((0.17, 0.1, 0.07), Relation.ON, True),
        (BESIDE, Relation.ON, False),
        (BESIDE, Relation.LEFT, True),
        (BESIDE, Relation.RIGHT, False),
        (BESIDE, Relation.OUTSIDE, True),
    ],
)
def test_relations_are_those_of_the_shared_module(place, relation: Relation, success: bool) -> None:
    verdict = execute_and_check(station(), BASE, pick_and_place(place=place), goal(relation)).verdict
    assert verdict.success is success, verdict


def test_what_stays_in_the_gripper_was_not_placed() -> None:
    motion = pick_and_place()
    closed = np.where(np.arange(len(motion.openings)) > 80, 0.0, motion.openings)
    verdict = execute_and_check(station(), BASE, replace(motion, openings=closed), goal(Relation.LEFT)).verdict
    assert (verdict.failed_phase, verdict.reason) == ("post_place", "not_released")


def test_an_arm_that_cannot_follow_is_found() -> None:
    """Its first command is 0.5 rad away from all that follow: a servo that is limited in force needs longer."""
    motion = pick_and_place()
    jumps = np.array(motion.positions)
    jumps[1:, 0] += 0.5
    verdict = execute_and_check(station(), BASE, replace(motion, positions=jumps), goal()).verdict
    assert (verdict.failed_phase, verdict.reason) == ("grasp", "servo_lag")
    assert "rad from its target on the way, more than 0.25" in verdict.detail


def test_an_arm_that_does_not_stand_where_it_should_is_found() -> None:
    """The last command is 0.1 rad away, too late to be reached, and little enough for the way."""
    motion = pick_and_place()
    late = np.array(motion.positions)
    late[-1, 0] += 0.1
    verdict = execute_and_check(station(), BASE, replace(motion, positions=late), goal()).verdict
    assert (verdict.failed_phase, verdict.reason) == ("post_place", "servo_lag")
    assert "rad from its target, more than 0.03" in verdict.detail


def test_nonsense_ends_as_unstable_and_not_in_numbers_that_look_good() -> None:
    broken = perturb_station(station(), "mass_minus_30", BLOCK)
    broken.model.opt.gravity[2] = 1e12
    verdict = execute_and_check(broken, BASE, pick_and_place(), goal()).verdict
    assert (verdict.success, verdict.reason) == (False, "simulation_unstable")


def test_rest_is_waited_for_but_not_for_ever(good: RolloutResult) -> None:
    told = len(pick_and_place().positions)
    assert told <= len(good.recording) < told + round(MAX_SETTLE_S / STEP_S)
    assert good.recording.phase[-1] == list(Phase).index(Phase.POST_PLACE)


def test_what_keeps_moving_is_not_at_rest() -> None:
    """On ice that tilts by a tenth of a degree the block slides on, still to the left of the reference.

    MuJoCo takes the larger friction of a pair: the pads keep theirs.
    """
    icy = perturb_station(station(), "mass_minus_30", BLOCK)
    own = np.isin(icy.model.geom_bodyid, [icy.model.body("table").id, icy.object_bodies[BLOCK]])
    icy.model.geom_friction[own] = 1e-6
    icy.model.opt.gravity[1] = -0.015
    proof = execute_and_check(icy, BASE, pick_and_place(), goal(Relation.LEFT))
    assert (proof.verdict.failed_phase, proof.verdict.reason) == ("post_place", "not_at_rest"), proof.verdict
    assert len(proof.recording) == len(pick_and_place().positions) + round(MAX_SETTLE_S / STEP_S)
    assert speed_at_the_end(proof) > 0.01


def _standing_on_edge(past_balance_rad: float) -> Station:
    """The bystander on a lower edge, so little past its balance that it is slow to begin to fall; it does not roll."""
    wide, tall = 0.03, 0.1
    here = Station(scene_files(), load_arm("panda"), BASE)
    body, first = here.object_bodies[BYSTANDER], here.object_qpos[BYSTANDER]
    lean = np.arctan2(wide, tall) + past_balance_rad
    across, up = np.array([np.cos(lean), np.sin(lean)]), np.array([-np.sin(lean), np.cos(lean)])
    y, z = (wide * across + tall * up) / 2
    here.model.qpos0[first : first + 7] = [-0.3, 0.15 + y, z, np.cos(lean / 2), np.sin(lean / 2), 0.0, 0.0]
    here.model.geom_friction[here.model.geom_bodyid == body, 2] = 1e-9
    return here


def test_sleep_does_not_hold_up_what_falls(monkeypatch: pytest.MonkeyPatch) -> None:
    """A block that has begun to topple is slower than MuJoCo's own bound for sleep, and would hang in the air."""
    leaning = _standing_on_edge(np.radians(0.3))
    asleep = execute_and_check(leaning, BASE, pick_and_place(), goal()).verdict
    assert leaning.model.opt.sleep_tolerance == 1e-3, "it is put back"
    monkeypatch.setattr(rollout, "SLEEP_TOLERANCE", 1e-3)
    frozen = execute_and_check(leaning, BASE, pick_and_place(), goal()).verdict
    monkeypatch.setattr(rollout, "SLEEP_TOLERANCE", 0.0)
    awake = execute_and_check(leaning, BASE, pick_and_place(), goal()).verdict
    assert (asleep.success, asleep.failed_phase, asleep.reason) == (False, awake.failed_phase, "disturbed")
    assert asleep.disturbed_m == pytest.approx(awake.disturbed_m, abs=1e-4)
    assert (frozen.success, frozen.disturbed_m < 1e-4) == (True, True), "else this block proves nothing"


def test_what_was_pushed_is_recorded_and_nothing_else() -> None:
    there = (0.04, 0.05, 0.05)
    pushed = execute_and_check(station(there), BASE, pick_and_place(over=(0.0, 0.06, 0.06)), goal()).recording
    assert pushed.moved_ids == (BYSTANDER,)
    way = pushed.moved_poses[:, 0]
    assert way.shape == (len(pushed), 7)
    assert way[0, :3] == pytest.approx(np.array(there), abs=1e-4)
    assert np.linalg.norm(way[-1, :3] - way[0, :3]) > 0.0005
    assert np.array_equal(pushed.poses_of(BYSTANDER), way)
    assert pushed.poses_of(REFERENCE) is None


def test_nothing_is_recorded_of_what_stood(good: RolloutResult) -> None:
    assert good.recording.moved_ids == ()
    assert good.recording.moved_poses.shape == (len(good.recording), 0, 7)


def test_a_motion_without_end_is_not_executed() -> None:
    motion = pick_and_place()
    slow = replace(
        motion,
        step_s=0.1,
        positions=np.repeat(motion.positions, 4, axis=0),
        openings=np.repeat(motion.openings, 4),
        phases=np.repeat(motion.phases, 4),
    )
    assert slow.duration_s > MAX_DURATION_S
    proof = execute_and_check(station(), BASE, slow, goal())
    assert (proof.verdict.success, proof.verdict.reason) == (False, "too_long")
    assert len(decode_recording(encode_recording(proof.recording))) == 1


@pytest.mark.parametrize(
    ("option", "found"),
    [
        (b'timestep="1e-9"', "timestep is 1e-09 s, and it is simulated in steps of at least 0.0001"),
        (b'ls_iterations="2000000000"', "ls_iterations is 2000000000, and at most 1000"),
    ],
)
def test_a_scene_that_would_be_simulated_for_ever_is_refused(option: bytes, found: str) -> None:
    files = scene_files()
    xml = files["scene.xml"].replace(b"<option ", b"<option " + option + b" ")
    assert xml != files["scene.xml"]
    endless = Station({**files, "scene.xml": xml}, load_arm("panda"), BASE)
    with pytest.raises(InputError, match=found):
        execute_and_check(endless, BASE, pick_and_place(), goal())


@pytest.mark.parametrize("step_s", [0.013, *(pytest.param(step_s, marks=pytest.mark.slow) for step_s in (0.02, 0.05))])
def test_samples_fall_on_steps_whatever_their_distance(step_s: float) -> None:
    motion = replace(pick_and_place(), step_s=step_s)
    execution = Rollout(station(), BASE, build_commands(motion), BLOCK, REFERENCE)
    own = station().model.opt.timestep
    samples = execution.samples()
    taken = [next(samples) for _ in range(4)]
    assert station().model.opt.timestep <= own
    samples.close()
    assert station().model.opt.timestep == own
    assert [sample.index for sample in taken] == [0, 1, 2, 3]


def test_changes_change_what_they_say_and_nothing_else() -> None:
    before, body = station().model, station().object_bodies[BLOCK]
    held = (before.geom_bodyid == body) | np.isin(np.arange(before.ngeom), station().finger_geoms)
    for name in PERTURBATIONS:
        after = perturb_station(station(), name, BLOCK).model
        assert after is not before
        friction = {"friction_halved": 0.5, "friction_doubled": 2.0}.get(name, 1.0)
        mass = {"mass_minus_30": 0.7, "mass_plus_30": 1.3}.get(name, 1.0)
        assert np.allclose(after.geom_friction[held, :2], friction * before.geom_friction[held, :2], 1e-12)
        assert np.array_equal(after.geom_friction[~held], before.geom_friction[~held])
        assert np.array_equal(after.geom_friction[:, 2], before.geom_friction[:, 2])
        assert after.body_mass[body] == pytest.approx(mass * before.body_mass[body])
        assert np.allclose(after.body_inertia[body], mass * before.body_inertia[body])
        assert np.array_equal(np.delete(after.body_mass, body), np.delete(before.body_mass, body))


def test_a_firm_grip_survives_all_changes_and_a_loose_one_does_not(good: RolloutResult) -> None:
    assert find_survived_perturbations(station(), BASE, pick_and_place(), goal()) == tuple(PERTURBATIONS)
    heavy = perturb_station(station(), "mass_plus_30", BLOCK)
    heavy.model.body_mass[heavy.object_bodies[BLOCK]] = 4.0
    verdicts = find_survived_perturbations(heavy, BASE, pick_and_place(), goal())
    assert "friction_halved" not in verdicts


def test_a_grip_is_quiet(good: RolloutResult) -> None:
    """Contact between pads and object neither chatters nor creeps: `implicitfast`, as the scene says."""
    assert station().model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    recording = good.recording
    carried = recording.phase == list(Phase).index(Phase.PRE_PLACE)
    assert np.abs(recording.qvel[carried, -2:]).max() < 1e-4, "the fingers stand"
    apart = np.linalg.norm(recording.object_pose[carried, :3] - recording.tcp[carried, :3], axis=1)
    assert np.ptp(apart) < 3e-4, "and the object with them"


@pytest.mark.parametrize(
    ("row", "found"),
    [
        ({"relation": "above", "x_id": BLOCK, "y_id": REFERENCE}, "no relation 'above'"),
        ({"relation": "on", "x_id": "../../etc/passwd", "y_id": REFERENCE}, "there is no assets/"),
        ({"relation": "on", "x_id": BLOCK}, "there is no assets/None.obj"),
        ({"relation": "on", "x_id": BLOCK, "y_id": BLOCK}, "a relation to itself"),
    ],
)
def test_a_goal_names_what_the_scene_lacks(row, found: str) -> None:
    with pytest.raises(InputError, match=found):
        load_goal(scene_files(), row, 0.02)


def test_commands_of_another_arm_are_refused() -> None:
    motion = pick_and_place()
    commands = build_commands(replace(motion, positions=motion.positions[:, :6]))
    with pytest.raises(InputError, match="6 joints, but panda has 7"):
        Rollout(station(), BASE, commands, BLOCK, REFERENCE)
