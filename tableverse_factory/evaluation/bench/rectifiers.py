"""Methods that remove collisions from a layout, compared by `bench lccr`."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from schemas.config import Config, RectifyConfig
from schemas.geometry import Frozen, Vector3
from tableverse_factory.core.seeding import make_rng
from tableverse_factory.evaluation.bench.free_simulation import (
    ReleasedScene,
    make_scene,
    simulate_near,
    simulate_to_rest,
)
from tableverse_factory.evaluation.bench.layouts import LayoutCase, make_parts
from tableverse_factory.stages.rectify.composites import AssembledLayout, assemble_composites
from tableverse_factory.stages.rectify.fault_check import are_near
from tableverse_factory.stages.rectify.groups import Group
from tableverse_factory.stages.rectify.joint import rectify_jointly
from tableverse_factory.stages.rectify.lccr import RectificationResult, rectify_lccr
from tableverse_factory.stages.rectify.radial import compute_outward, list_members
from tableverse_factory.stages.rectify.rigid_part import RigidPart, compute_center
from tableverse_factory.stages.settle import list_seen_poses

STEP_M = 0.001


@dataclass(frozen=True, slots=True, eq=False)
class MethodResult(Frozen):
    """Result of a method on a layout."""

    layout: AssembledLayout  # as it started: containers filled, contents that do not fit left out
    scene: ReleasedScene  # the same objects in the same order at their resulting poses
    seconds: float  # CPU time, without decomposition [s]
    restless: bool = False  # whether an object still moved at the time limit of the simulation
    simulated: bool = False  # whether the method simulates


Method = Callable[[LayoutCase, Config], MethodResult]
Rectifier = Callable[[Sequence[RigidPart], RectifyConfig], RectificationResult]


def rectify_in_steps(parts: Sequence[RigidPart], config: RectifyConfig) -> RectificationResult:
    """Run LCCR with equation (2) searched in steps of `STEP_M`; the second spread, of the final shapes, is exact."""
    return rectify_lccr(parts, config, _spread_in_steps)


def _spread_in_steps(parts: Sequence[RigidPart], ordered: Sequence[Group], clearance_m: float) -> list[RigidPart]:
    moved = list(parts)
    anchors = list(list_members(moved, ordered[0]))
    origin = compute_center(anchors)
    for own in ordered[1:]:
        mine = list_members(moved, own)
        offset = _find_free_step(mine, anchors, compute_outward(mine, origin), clearance_m)
        for i in (i for entity in own for i in entity):
            moved[i] = moved[i].moved(offset)
            anchors.append(moved[i])
    return moved


def _find_free_step(
    mine: Sequence[RigidPart], anchors: Sequence[RigidPart], direction: Vector3, clearance_m: float
) -> Vector3:
    offset = np.zeros(3)
    while any(are_near(part.moved(offset), anchor, clearance_m) for part in mine for anchor in anchors):
        offset = offset + STEP_M * direction
    return offset


def _fill_containers(case: LayoutCase, config: Config) -> AssembledLayout:
    return assemble_composites(case.item, case.pieces, config, make_rng(config.run.seed, case.name, "rectify"))


def _keep_poses(case: LayoutCase, config: Config) -> MethodResult:
    start = time.process_time()
    filled = _fill_containers(case, config)
    return MethodResult(filled, make_scene(filled.placed, filled.pieces, filled.poses), time.process_time() - start)


def _make_rectification(rectifier: Rectifier) -> Method:
    def method(case: LayoutCase, config: Config) -> MethodResult:
        start = time.process_time()
        filled = _fill_containers(case, config)
        moved = rectifier(make_parts(filled.placed.objects, filled.pieces, filled.poses), config.rectify).parts
        seconds = time.process_time() - start
        poses = [part.pose_now(pose) for pose, part in zip(filled.poses, moved, strict=True)]
        return MethodResult(filled, make_scene(filled.placed, filled.pieces, poses), seconds)

    return method


def _make_simulation(before: Method, gentle: bool) -> Method:
    """Simulate as the settle stage does after `lccr`, gently or not."""

    def method(case: LayoutCase, config: Config) -> MethodResult:
        start = time.process_time()
        given = before(case, config)
        scene, resting = simulate_to_rest(given.scene, config.settle, gentle)
        return MethodResult(given.layout, scene, time.process_time() - start, not resting, simulated=True)

    return method


def _settle_near_seen(case: LayoutCase, config: Config) -> MethodResult:
    """Run the settle stage after `joint`."""
    start = time.process_time()
    given = _rectify_jointly(case, config)
    seen = list_seen_poses(given.layout.placed.objects)
    scene, resting = simulate_near(given.scene, seen, config.settle)
    return MethodResult(given.layout, scene, time.process_time() - start, not resting, simulated=True)


_rectify_jointly = _make_rectification(rectify_jointly)

RECTIFICATION_METHODS: dict[str, Method] = {
    "Direct": _keep_poses,
    "MuJoCo alone": _make_simulation(_keep_poses, gentle=False),
    "settle alone": _make_simulation(_keep_poses, gentle=True),
    "1 mm steps": _make_rectification(rectify_in_steps),
    "LCCR": _make_rectification(rectify_lccr),
    "LCCR + sim": _make_simulation(_make_rectification(rectify_lccr), gentle=True),
    "joint": _rectify_jointly,
    "joint + sim": _settle_near_seen,
}
"""`MuJoCo alone` simulates the layout as it is; `settle alone` runs the settle stage, which damps the first motion."""

DEFAULT_METHODS = tuple(name for name in RECTIFICATION_METHODS if name != "settle alone")
