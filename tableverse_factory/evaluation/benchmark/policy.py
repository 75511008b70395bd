"""Protocol of a policy: what the benchmark tells it, and what it has to answer.

    class Wait:
        pictures: tuple[str, ...] = ()
        picture_size = (96, 128)

        def reset(self, start: EpisodeStart) -> None:
            self._action = start.to_action([*HOME, 0.08])

        def act(self, observation: Mapping[str, np.ndarray]) -> np.ndarray:
            return self._action

One instance plays many episodes, one after the other, in an order that depends on the number of workers: what it does
may depend on the present episode alone.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, Float64

from schemas.curation import Relation
from schemas.geometry import Frozen, Points, Pose, TriangleMesh
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.delivery.episodes.pictures import check_pictures

if TYPE_CHECKING:
    from tableverse_factory.delivery.learning.environment import TableEnv

POINTS_PER_OBJECT = 256
MAX_PICTURE_SIDE_PX = 1024


@dataclass(frozen=True, slots=True, eq=False)
class EpisodeStart(Frozen):
    """What is constant in an episode and known to a fair policy."""

    episode_id: str
    seed: int  # for what the policy draws
    instruction: str
    relation: Relation  # of X to Y
    points: Float32[np.ndarray, "n p 3"]  # on the surfaces of X, Y and all others, each in its own body frame [m]
    robot: str
    base: Pose  # of the arm in the table frame
    lower: Float64[np.ndarray, " k"]  # command of the action −1: joints [rad], then the opening [m]
    upper: Float64[np.ndarray, " k"]  # command of the action 1
    step_s: float  # time that an action takes
    limit_steps: int  # actions after which the episode is lost
    env: "TableEnv | None" = None  # the environment itself, for policies with `privileged = True`

    def to_action(self, command: Float64[np.ndarray, " k"]) -> Float32[np.ndarray, " k"]:
        """Convert targets of the joints [rad] and the opening [m] to an action, clipped to −1 … 1."""
        share = (np.asarray(command, dtype=np.float64) - self.lower) / (self.upper - self.lower)
        return np.clip(2.0 * share - 1.0, -1.0, 1.0).astype(np.float32)


@runtime_checkable
class Policy(Protocol):
    """Policy under test.

    Attributes:
        pictures: Pictures in its observations (`delivery.episodes.pictures.PICTURES`); none for a policy on states.
        picture_size: Their height and width [px].

    A policy with the attribute `privileged`, true, gets the environment itself as `EpisodeStart.env`; the results of
    such a policy say so.
    """

    pictures: tuple[str, ...]
    picture_size: tuple[int, int]

    def reset(self, start: EpisodeStart) -> None:
        """Begin an episode and forget the one before."""

    def act(self, observation: Mapping[str, np.ndarray]) -> np.ndarray:
        """Choose the next action from an observation of `TableEnv`. Shape (j + 1,), each from −1 to 1.

        Pictures are drawn when they are looked at, within this call alone.
        """


class PolicyError(Exception):
    """A policy failed: `reason` is a word of small letters and underscores; the message is one line."""

    def __init__(self, reason: str, detail: str) -> None:
        super().__init__(detail)
        self.reason = reason


class PolicyGoneError(InputError):
    """The process of a policy has ended between episodes: the run ends, and the same command goes on with it."""


def is_privileged(policy: Policy) -> bool:
    """Return whether a policy asks for the environment itself."""
    return bool(getattr(policy, "privileged", False))


def check_policy(policy: Any, name: str) -> Policy:
    """Check that an object has what the protocol asks for.

    Raises:
        InputError: `bad_policy`, naming what is missing or wrong.
    """
    if missing := [method for method in ("reset", "act") if not callable(getattr(policy, method, None))]:
        raise InputError(f"policy {name} has no method `{missing[0]}` (evaluation.benchmark.policy)", "bad_policy")
    pictures, size = getattr(policy, "pictures", None), getattr(policy, "picture_size", None)
    if not isinstance(pictures, tuple) or not all(isinstance(picture, str) for picture in pictures):
        shown = sanitize_line(repr(pictures), 80)
        raise InputError(f"policy {name}: pictures {shown}: give a tuple of names, () for none", "bad_policy")
    check_pictures(pictures)
    if not isinstance(size, tuple) or len(size) != 2 or not all(_is_side(side) for side in size):
        shown = sanitize_line(repr(size), 80)
        raise InputError(
            f"policy {name}: picture_size {shown}: give (height, width), each from 1 to {MAX_PICTURE_SIDE_PX} px",
            "bad_policy",
        )
    checked: Policy = policy
    return checked


def _is_side(side: object) -> bool:
    return isinstance(side, int) and not isinstance(side, bool) and 1 <= side <= MAX_PICTURE_SIDE_PX


def check_action(action: Any, length: int) -> Float32[np.ndarray, " k"]:
    """Check a policy's answer and clip it to −1 … 1.

    Raises:
        PolicyError: `bad_action` if it is not `length` finite numbers.
    """
    try:
        numbers = np.asarray(action, dtype=np.float32)
    except (TypeError, ValueError) as error:
        raise PolicyError("bad_action", sanitize_line(f"no numbers: {error}", 200)) from None
    if numbers.shape != (length,) or not np.isfinite(numbers).all():
        shown = sanitize_line(np.array2string(numbers, precision=3, threshold=10), 120)
        raise PolicyError("bad_action", f"{shown} of shape {numbers.shape}: give {length} finite numbers")
    return np.clip(numbers, -1.0, 1.0)


def sample_points(mesh: TriangleMesh, count: int, rng: np.random.Generator) -> Float32[np.ndarray, "p 3"]:
    """Draw points of a surface, evenly by area, in the mesh's own frame [m]."""
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    total = float(areas.sum())
    if not total > 0.0:
        return mesh.vertices[rng.integers(len(mesh.vertices), size=count)].astype(np.float32)
    triangle = np.minimum(np.searchsorted(np.cumsum(areas) / total, rng.random(count)), len(areas) - 1)
    u, v = rng.random((2, count, 1))
    fold = u + v > 1.0
    u, v = np.where(fold, 1.0 - u, u), np.where(fold, 1.0 - v, v)
    points: Points = a[triangle] + u * (b - a)[triangle] + v * (c - a)[triangle]
    return points.astype(np.float32)
