"""Whole motions: phases in order, nothing jumps, nothing touches, limits hold; and the reason where there is none."""

from dataclasses import replace

import numpy as np
import pytest

from schemas.config import TrajectoriesConfig
from schemas.geometry import Pose, TriangleMesh
from schemas.trajectories import Motion, NoMotion, Phase
from tableverse_factory.geometry.math.transforms import rotation_angle
from tableverse_factory.robotics.motion.kinematics import solve_ik
from tableverse_factory.robotics.motion.obstacles import list_boxed_objects
from tableverse_factory.robotics.motion.phases import plan_motion
from tableverse_factory.robotics.motion.rrt import RrtConnect
from tableverse_factory.robotics.motion.segments import PathSegment, time_segments
from tableverse_factory.robotics.motion.validate import validate_motion
from tableverse_factory.robotics.motion.world import CollisionSpace, CollisionWorld
from tests.helpers.simple_scenes import Solid, box
from tests.helpers.work_cells import (
    BLOCK,
    CONFIG,
    GRASP_M,
    HOME,
    WIDTH_M,
    block,
    clutter,
    deepest,
    down,
    held_pose,
    object_geoms,
    open_box,
    station_of,
)

PHASES = list(Phase)
GRASP = down(0.0, 0.0, GRASP_M)


def planned(world: CollisionWorld, place: Pose, grasp: Pose = GRASP, seed: int = 0) -> Motion | NoMotion:
    return plan_motion(world, HOME, grasp, place, BLOCK, WIDTH_M, CONFIG, np.random.default_rng(seed), RrtConnect())


@pytest.fixture(scope="module")
def motion() -> Motion:
    found = planned(clutter(), down(-0.12, -0.1, GRASP_M + 0.004, 1.0))
    assert isinstance(found, Motion)
    return found


def last(motion: Motion, phase: Phase) -> int:
    return int(np.flatnonzero(motion.phases == PHASES.index(phase))[-1])


def test_the_gripper_is_where_each_phase_ends(motion):
    world, place = clutter(), down(-0.12, -0.1, GRASP_M + 0.004, 1.0)
    for phase, wanted in ((Phase.GRASP, GRASP), (Phase.PLACE, place)):
        tcp = world.tcp(motion.positions[last(motion, phase)])
        assert np.linalg.norm(tcp.position - wanted.position) < 1e-4
        assert rotation_angle(tcp.quaternion_wxyz, wanted.quaternion_wxyz) < 1e-3
    heights = {phase: world.tcp(motion.positions[last(motion, phase)]).position[2] for phase in PHASES}
    assert heights[Phase.PRE_GRASP] == pytest.approx(GRASP_M + 0.08, abs=0.015)  # blended through
    assert heights[Phase.POST_GRASP] == pytest.approx(GRASP_M + 0.16, abs=0.015)
    assert heights[Phase.PRE_PLACE] == pytest.approx(GRASP_M + 0.164, abs=0.015)
    assert heights[Phase.POST_PLACE] == pytest.approx(GRASP_M + 0.084, abs=1e-3)


def test_the_last_centimetres_to_a_touch_are_straight(motion):
    world = clutter()
    tcps = [world.tcp(q).position for q in motion.positions]
    for index, tcp in enumerate(tcps):
        if motion.phases[index] in (1, 2) and tcp[2] < GRASP_M + 0.04:
            assert np.linalg.norm(tcp[:2]) < 2e-4


def test_phases_follow_each_other_and_nothing_jumps(motion):
    assert np.unique(motion.phases).tolist() == list(range(6))
    assert (np.diff(motion.phases) >= 0).all()
    v = motion.velocities
    assert motion.positions[0] == pytest.approx(HOME, abs=1e-12)
    assert np.abs(v[[0, -1]]).max() == 0.0
    arm, step = clutter().station.arm, motion.step_s
    assert (np.abs(v) <= CONFIG.speed * arm.max_velocity).all()
    assert (np.abs(np.diff(v, axis=0)) <= CONFIG.speed * arm.max_acceleration * step * (1 + 1e-9)).all()
    mean = (v[1:] + v[:-1]) / 2 * step
    assert (
        np.abs(np.diff(motion.positions, axis=0) - mean) <= 0.5 * arm.max_acceleration * CONFIG.speed * step**2
    ).all()


def test_the_arm_stands_while_the_fingers_move(motion):
    moving = np.flatnonzero(np.diff(motion.openings))
    assert (motion.velocities[moving] == 0.0).all()
    assert (motion.velocities[moving + 1] == 0.0).all()
    assert (np.abs(np.diff(motion.openings)) <= clutter().station.arm.max_opening_speed * motion.step_s + 1e-9).all()
    assert motion.openings[last(motion, Phase.GRASP)] < WIDTH_M < motion.openings[0]
    assert motion.openings[last(motion, Phase.PLACE)] == motion.openings[-1] > WIDTH_M


def test_nothing_touches_by_the_distance_of_every_pair(motion):
    world, held = clutter(), held_pose(GRASP, clutter().object_pose(BLOCK))
    lift, release = last(motion, Phase.GRASP), last(motion, Phase.PLACE)
    for index in range(0, last(motion, Phase.PLACE), 4):
        q = motion.positions[index]
        if index < lift - 20:
            assert deepest(world, q, float(motion.openings[0]), None, object_geoms(world)) > -1e-5
        elif lift < index < release:
            assert deepest(world, q, WIDTH_M, held, object_geoms(world)) > -1e-5


def test_the_same_seed_gives_the_same_bytes(motion):
    again = planned(clutter(), down(-0.12, -0.1, GRASP_M + 0.004, 1.0))
    for name in ("positions", "velocities", "openings", "phases"):
        assert getattr(again, name).tobytes() == getattr(motion, name).tobytes()


def test_a_release_inside_the_table_is_raised_and_that_is_said():
    found = planned(clutter(), down(-0.12, -0.1, GRASP_M - 0.001, 1.0))
    assert isinstance(found, Motion)
    assert any("higher" in words for words in found.fallbacks)
    assert clutter().tcp(found.positions[last(found, Phase.PLACE)]).position[2] > GRASP_M


@pytest.mark.parametrize(
    ("grasp", "place", "phase", "reason"),
    [
        (down(1.5, 0.0, 0.07), down(-0.12, -0.1, 0.074), Phase.GRASP, "out_of_reach"),
        (GRASP, down(1.5, 0.0, 0.074), Phase.PLACE, "out_of_reach"),
        (down(0.0, 0.0, -0.02), down(-0.12, -0.1, 0.074), Phase.GRASP, "blocked"),
        (GRASP, down(0.12, 0.05, 0.074), Phase.PLACE, "blocked"),  # where a post stands
    ],
)
def test_what_cannot_be_is_said_with_its_phase(grasp, place, phase, reason):
    found = planned(clutter(), place, grasp)
    assert isinstance(found, NoMotion)
    assert (found.phase, found.reason) == (phase, reason)
    assert found.detail


_DOWN = np.array([0.0, 0.0, 0.04])


def test_where_something_hangs_over_the_way_up_the_lift_leans_away_and_that_is_said():
    foot = box(0.09, 0.05, 0.02)
    footed = replace(block(0.0, 0.0), hulls=(block(0.0, 0.0).mesh, TriangleMesh(foot.vertices - _DOWN, foot.faces)))
    shelf = Solid(box(0.06, 0.06, 0.04), (0.072, 0.0, 0.06), object_id="shelf")  # 3 mm of the foot are below it
    world = CollisionWorld(station_of([footed, shelf]))
    found = planned(world, down(-0.2, 0.0, GRASP_M + 0.004))
    assert isinstance(found, Motion), found
    assert "post_grasp: slanted" in found.fallbacks
    assert world.tcp(found.positions[last(found, Phase.POST_GRASP)]).position[0] < -0.02


def test_an_object_is_put_into_an_open_box_and_fingers_come_out_again():
    tray = Solid(box(0.3, 0.3, 0.1), (0.22, 0.05, 0.05), object_id="tray", hulls=open_box())
    world = CollisionWorld(station_of([block(-0.15, 0.0), tray]))
    grasp, place = down(-0.15, 0.0, GRASP_M), down(0.22, 0.05, GRASP_M + 0.015)
    found = planned(world, place, grasp)
    assert isinstance(found, Motion), found
    inside = world.tcp(found.positions[last(found, Phase.PLACE)]).position
    np.testing.assert_allclose(inside, place.position, atol=1e-4)


def shifted(motion: Motion, **changes: np.ndarray) -> Motion:
    return replace(motion, **changes)


def test_the_recheck_sees_what_is_wrong(motion):
    world = clutter()

    def fault(changed: Motion) -> str:
        found = validate_motion(world, changed, BLOCK, WIDTH_M, CONFIG)
        return "" if found is None else found.detail

    assert fault(motion) == ""
    q, v = np.array(motion.positions), np.array(motion.velocities)
    jump = q.copy()
    jump[40:] += 0.05
    assert "continuity" in fault(replace(motion, positions=jump))
    assert "velocity" in fault(replace(motion, velocities=v * 3))
    assert "position" in fault(replace(motion, positions=q + 3.0))
    assert "order" in fault(replace(motion, phases=motion.phases[::-1].copy()))
    assert "order" in fault(replace(motion, phases=np.minimum(motion.phases, 4)))
    low = planned(CollisionWorld(station_of([block(0.0, 0.0)])), down(-0.12, -0.1, GRASP_M + 0.004, 1.0))
    wall = Solid(box(0.02, 0.3, 0.5), (-0.06, -0.05, 0.25), object_id="wall")
    walled = CollisionWorld(station_of([block(0.0, 0.0), wall]))
    seen = validate_motion(walled, low, BLOCK, WIDTH_M, CONFIG)
    assert seen is not None
    assert "wall" in seen.detail


def test_what_stands_in_the_table_may_be_lifted_out_but_not_carried_through_it():
    sunk = Solid(box(WIDTH_M, WIDTH_M, 0.1), (0.0, 0.0, 0.0495), object_id=BLOCK)
    world = CollisionWorld(station_of([sunk]))
    found = planned(world, down(-0.12, -0.1, GRASP_M + 0.004))
    assert isinstance(found, Motion), found
    early = np.array(found.phases)
    lift = np.flatnonzero(early == PHASES.index(Phase.POST_GRASP))
    early[lift[1:]] = PHASES.index(Phase.PRE_PLACE)
    fault = validate_motion(world, replace(found, phases=early), BLOCK, WIDTH_M, CONFIG)
    assert fault is not None
    assert fault.phase is Phase.PRE_PLACE
    assert "table" in fault.detail


def test_too_heavy_a_load_is_not_lifted():
    world = CollisionWorld(station_of([block(0.0, 0.0)], mass_kg=25.0))
    found = planned(world, down(0.2, -0.1, GRASP_M + 0.004))
    assert isinstance(found, NoMotion)
    assert (found.phase, found.reason) == (Phase.PLACE, "too_fast")
    assert "torque" in found.detail


def test_a_run_through_a_wall_is_no_matter_of_limits():
    wall = Solid(box(0.02, 0.3, 0.5), (-0.06, -0.05, 0.25), object_id="wall")
    world = CollisionWorld(station_of([block(0.0, 0.0), wall]))
    ends = [
        solve_ik(world.chain, world.in_base(tcp), HOME, 1)[0] for tcp in (down(0.05, 0.0, 0.2), down(-0.2, 0.0, 0.2))
    ]
    sections = [PathSegment(Phase.PRE_GRASP, np.array(ends), CollisionSpace(world, 0.04))]
    config = TrajectoriesConfig(speed=0.5, step_s=0.02)
    found = time_segments(sections, config, touch_at_start=False, touch_at_end=False)
    assert isinstance(found, NoMotion)
    assert (found.phase, found.reason) == (Phase.PRE_GRASP, "no_blend")
    assert "wall" in found.detail


def test_a_line_that_something_ends_early_is_said():
    foot = box(0.09, 0.05, 0.02)
    footed = replace(block(0.0, 0.0), hulls=(block(0.0, 0.0).mesh, TriangleMesh(foot.vertices - _DOWN, foot.faces)))
    shelf = Solid(box(0.06, 0.06, 0.02), (0.072, 0.0, 0.138), object_id="shelf")  # above the foot by 0.108 m
    found = planned(CollisionWorld(station_of([footed, shelf])), down(-0.2, 0.0, GRASP_M + 0.004))
    assert isinstance(found, Motion), found
    assert "post_grasp: 0.105 m" in found.fallbacks


def test_a_margin_that_cannot_be_kept_is_said():
    foot = box(0.16, 0.05, 0.02)
    footed = replace(block(0.0, 0.0), hulls=(block(0.0, 0.0).mesh, TriangleMesh(foot.vertices - _DOWN, foot.faces)))
    shelf = Solid(box(0.06, 0.06, 0.02), (-0.315, 0.0, 0.174), object_id="shelf")  # 5 mm from where a lowering begins
    found = planned(CollisionWorld(station_of([footed, shelf])), down(-0.2, 0.0, GRASP_M + 0.004))
    assert isinstance(found, Motion), found
    assert found.fallbacks == ("pre_place: margin 3 mm",)


def test_what_a_planner_sees_as_a_box_is_said():
    class Boxing(RrtConnect):
        def list_fallbacks(self, world: CollisionWorld) -> tuple[str, ...]:
            return list_boxed_objects(world)

    half = box(0.06, 0.06, 0.05)
    halves = tuple(TriangleMesh(half.vertices + np.array([0.0, 0.0, z]), half.faces) for z in (-0.025, 0.025))
    stacked = Solid(box(0.06, 0.06, 0.1), (0.2, 0.1, 0.05), object_id="stacked", hulls=halves)  # with a wall inside
    world = CollisionWorld(station_of([block(0.0, 0.0), stacked]))
    place = down(-0.12, -0.1, GRASP_M + 0.004)
    found = plan_motion(world, HOME, GRASP, place, BLOCK, WIDTH_M, CONFIG, np.random.default_rng(0), Boxing())
    assert isinstance(found, Motion), found
    assert found.fallbacks == ("obstacles: stacked as its box (open)",)
