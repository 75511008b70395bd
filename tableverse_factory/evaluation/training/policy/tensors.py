"""Demonstrations as tensors on a device: metres, matrices, and the two goals of each."""

from typing import Any

import numpy as np

from tableverse_factory.core.errors import InputError
from tableverse_factory.evaluation.training.policy.choose_motions import choose_motions
from tableverse_factory.evaluation.training.policy.demonstrations import (
    OPENING_M,
    POINT_M,
    POSITION_M,
    QUATERNION,
    RELATIONS,
    Demonstrations,
)
from tableverse_factory.evaluation.training.policy.rotations import apply, matrix_from_quaternion
from tableverse_factory.models.local.device import Tensor, import_torch

torch = import_torch()

KINDS = 5  # of relations: on, in, next to, outside, and the four sides
KIND_OF = {"on": 0, "in": 1, "into": 1, "inside": 1, "next to": 2, "outside": 3}
SIDES = {
    "to the left of": (-1.0, 0.0),
    "to the right of": (1.0, 0.0),
    "in front of": (0.0, -1.0),
    "behind": (0.0, 1.0),
}
PRE_GRASP, GRASP, POST_GRASP, PRE_PLACE, PLACE, POST_PLACE = range(6)


class DemonstrationTensors:
    """Demonstrations as tensors; a `…_turn` is a matrix and a `…_at` a position, in the table frame."""

    def __init__(
        self, demonstrations: Demonstrations, device: str, scenes: int | None = None, motions: int | None = None
    ) -> None:
        """Copy them to the device; InputError where one has no grasp or no release.

        Of those that are not held out, `choose_motions` chooses which are learnt.
        """
        own = demonstrations

        def load(array: np.ndarray, unit: float = 1.0) -> Tensor:
            return torch.tensor(array.astype(np.float32) * unit, device=device)

        def turn(array: np.ndarray, unit: float = 1.0) -> Tensor:
            return matrix_from_quaternion(load(array[:, 3:], unit))

        self.points = load(own.points, POINT_M)
        self.object_at, self.object_turn = load(own.poses[:, :3]), turn(own.poses)
        self.objects = torch.tensor(own.objects.astype(np.int64), device=device)
        self.base_at, self.base_turn = load(own.bases[:, :3]), turn(own.bases)
        self.tcp_at, self.tcp_turn = load(own.tcp[:, :3], POSITION_M), turn(own.tcp, QUATERNION)
        self.carried_at, self.carried_turn = load(own.carried[:, :3], POSITION_M), turn(own.carried, QUATERNION)
        self.opening = load(own.opening, OPENING_M)
        self.phases = torch.tensor(own.phases.astype(np.int64), device=device)
        self.last = torch.tensor(own.ends.astype(np.int64) - 1, device=device)
        self.first = torch.cat([torch.zeros_like(self.last[:1]), self.last[:-1] + 1])
        counts = np.diff(own.ends, prepend=0)
        self.owner = torch.tensor(np.repeat(np.arange(len(own)), counts), device=device)
        begins = np.r_[
            True, (np.diff(own.phases.astype(int)) != 0) | (np.diff(np.repeat(np.arange(len(own)), counts)) != 0)
        ]
        starts = np.maximum.accumulate(np.where(begins, np.arange(len(begins)), 0))
        self.phase_start = torch.tensor(starts, device=device)  # first sample of each sample's phase
        kinds, sides = describe_relations([RELATIONS[k] for k in own.relations])
        self.kind, self.side = kinds.to(device), sides.to(device)
        self._find_goals(own, device)
        learnt, held_out = choose_motions(own, scenes, motions), own.held_out.astype(bool)
        self.choices = {
            False: self._list(torch.tensor(learnt, device=device)),
            True: self._list(torch.tensor(held_out, device=device)),
        }

    def _list(self, chosen: Tensor) -> tuple[Tensor, Tensor]:
        """List the chosen demonstrations and their samples."""
        return chosen.nonzero()[:, 0], chosen[self.owner].nonzero()[:, 0]

    def _find_goals(self, own: Demonstrations, device: str) -> None:
        """Find the samples at which the fingers are about to lift and to leave, and the openings about them."""
        found = []
        for start, end in zip((own.ends - np.diff(own.ends, prepend=0)).tolist(), own.ends.tolist(), strict=True):
            last = [np.flatnonzero(own.phases[start:end] == phase) for phase in range(6)]
            if not all(len(each) for each in last):
                raise InputError("a demonstration lacks one of the six phases: pack successful motions only")
            found.append([start + each[-1] for each in last])
        ends = torch.tensor(np.array(found), device=device)
        self.grasp_at, self.grasp_turn = self.tcp_at[ends[:, GRASP]], self.tcp_turn[ends[:, GRASP]]
        self.place_at, self.place_turn = self.tcp_at[ends[:, PLACE]], self.tcp_turn[ends[:, PLACE]]
        commanded = self.opening[:, 0]
        self.holding = commanded[ends[:, POST_GRASP]]
        self.openings = torch.stack([commanded[ends[:, PRE_GRASP]], commanded[ends[:, POST_PLACE]]], 1)

    def place_points(self, demos: Tensor, count: int) -> tuple[Tensor, Tensor]:
        """Place `count` points of each object, whose order is random, where it stands.

        Returns:
            Points of shape (b, r, count, 3) in the table frame, and which objects are there, of shape (b, r).
        """
        rows = self.objects[demos]
        index = rows.clamp(min=0)
        kept, device = self.points.shape[1], self.points.device
        drawn = (torch.randint(kept, (1,), device=device) + torch.arange(count, device=device)) % kept
        points = self.points[:, drawn][index]
        placed = apply(self.object_turn[index][:, :, None], points) + self.object_at[index][:, :, None]
        return placed, rows >= 0


def describe_relations(relations: list[str]) -> tuple[Any, Any]:
    """Return the kind of each relation, and its side of Y as x and y of the table frame. Shapes (b,) and (b, 2)."""
    kinds = torch.tensor([KIND_OF.get(relation, KINDS - 1) for relation in relations])
    sides = torch.tensor([SIDES.get(relation, (0.0, 0.0)) for relation in relations])
    return kinds, sides
