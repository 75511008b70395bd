"""The ways to make a layout collision-free that `bench lccr` compares."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from schemas.config import Config, RectifyConfig
from schemas.geometry import Frozen, Vector3
from tableverse_factory.core.seeding import rng_for
from tableverse_factory.evaluation.bench.layouts import Case, parts_at
from tableverse_factory.evaluation.bench.release import ReleasedScene, at_rest, scene_at
from tableverse_factory.stages.rectify.composites import Assembled, assemble
from tableverse_factory.stages.rectify.fault_check import are_near
from tableverse_factory.stages.rectify.groups import Group
from tableverse_factory.stages.rectify.joint import joint
from tableverse_factory.stages.rectify.lccr import Rectified, lccr
from tableverse_factory.stages.rectify.radial import members, outward
from tableverse_factory.stages.rectify.rigid_part import RigidPart, center_of

STEP_M = 0.001


@dataclass(frozen=True, slots=True, eq=False)
class Result(Frozen):
    """What a method makes of a layout.

    Attributes:
        layout: What it started from: containers filled, contents that do not fit left out.
        scene: The same objects in the same order, where it puts them.
        seconds: CPU time it took, without decomposition [s].
        restless: Whether it simulated until the time was up, and something still moved.
        simulated: Whether it simulated at all.
    """

    layout: Assembled
    scene: ReleasedScene
    seconds: float
    restless: bool = False
    simulated: bool = False


Method = Callable[[Case, Config], Result]
Rectifier = Callable[[Sequence[RigidPart], RectifyConfig], Rectified]


def stepped(parts: Sequence[RigidPart], config: RectifyConfig) -> Rectified:
    """LCCR with equation (2) searched in steps of `STEP_M`, the plain way to solve it; all else is the same.

    Where groups are spread a second time, with their final shapes, that is exact again.
    """
    return lccr(parts, config, _spread_in_steps)


def _spread_in_steps(parts: Sequence[RigidPart], ordered: Sequence[Group], clearance_m: float) -> list[RigidPart]:
    moved = list(parts)
    anchors = list(members(moved, ordered[0]))
    origin = center_of(anchors)
    for own in ordered[1:]:
        mine = members(moved, own)
        offset = _first_free_step(mine, anchors, outward(mine, origin), clearance_m)
        for i in (i for entity in own for i in entity):
            moved[i] = moved[i].moved(offset)
            anchors.append(moved[i])
    return moved


def _first_free_step(
    mine: Sequence[RigidPart], anchors: Sequence[RigidPart], direction: Vector3, clearance_m: float
) -> Vector3:
    offset = np.zeros(3)
    while any(are_near(part.moved(offset), anchor, clearance_m) for part in mine for anchor in anchors):
        offset = offset + STEP_M * direction
    return offset


def _filled(case: Case, config: Config) -> Assembled:
    return assemble(case.item, case.pieces, config, rng_for(config.run.seed, case.name, "rectify"))


def _direct(case: Case, config: Config) -> Result:
    start = time.process_time()
    filled = _filled(case, config)
    return Result(filled, scene_at(filled.placed, filled.pieces, filled.poses), time.process_time() - start)


def _rectified(rectifier: Rectifier) -> Method:
    def method(case: Case, config: Config) -> Result:
        start = time.process_time()
        filled = _filled(case, config)
        moved = rectifier(parts_at(filled.placed.objects, filled.pieces, filled.poses), config.rectify).parts
        seconds = time.process_time() - start
        poses = [part.pose_now(pose) for pose, part in zip(filled.poses, moved, strict=True)]
        return Result(filled, scene_at(filled.placed, filled.pieces, poses), seconds)

    return method


def _simulated(before: Method, gentle: bool) -> Method:
    def method(case: Case, config: Config) -> Result:
        start = time.process_time()
        given = before(case, config)
        scene, resting = at_rest(given.scene, config.settle, gentle)
        return Result(given.layout, scene, time.process_time() - start, not resting, simulated=True)

    return method


METHODS: dict[str, Method] = {
    "Direct": _direct,
    "MuJoCo alone": _simulated(_direct, gentle=False),
    "settle alone": _simulated(_direct, gentle=True),
    "1 mm steps": _rectified(stepped),
    "LCCR": _rectified(lccr),
    "LCCR + sim": _simulated(_rectified(lccr), gentle=True),
    "joint": _rectified(joint),
    "joint + sim": _simulated(_rectified(joint), gentle=True),
}
"""`MuJoCo alone` lets the layout go as it is; `settle alone` does so in our settle stage, which starts as in honey."""

USUAL = tuple(name for name in METHODS if name != "settle alone")
"""What is compared unless somebody asks for others."""
