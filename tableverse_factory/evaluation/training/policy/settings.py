"""Settings of a training of policies, and how far it has come."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class PolicySettings:
    """Settings that determine the weights, with the demonstrations and the device.

    Attributes:
        steps: A continued training may change them, and with them its schedule.
        goals: Goals per step.
        flows: Noises per goal.
        chunks: Chunks per step, of a policy on states.
        views: Views per step, of a policy on pictures.
        rate: Peak of the learning rate.
        scenes: Number of the scenes whose motions are learnt; None for all.
        motions: Number of motions that are learnt, taken from these scenes in turn; None for all.
    """

    steps: int
    seed: int = 0
    goals: int = 128
    flows: int = 8
    chunks: int = 512
    views: int = 64
    rate: float = 6e-4
    scenes: int | None = None
    motions: int | None = None


@dataclass(frozen=True, slots=True)
class PolicyPosition:
    """How far a training has come."""

    step: int = 0
