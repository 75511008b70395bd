"""Settings of a training of policies, and how far it has come."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class PolicySettings:
    """Settings that determine the weights, with the demonstrations and the device.

    Attributes:
        steps: A continued training may change them, and with them its schedule.
        goals: Goals per step.
        flows: Noises per goal.
        chunks: Chunks per step.
        rate: Peak of the learning rate.
    """

    steps: int
    seed: int = 0
    goals: int = 256
    flows: int = 8
    chunks: int = 1024
    rate: float = 6e-4


@dataclass(frozen=True, slots=True)
class PolicyPosition:
    """How far a training has come; `demonstrations` is the sha256 of their file."""

    step: int = 0
    demonstrations: str = ""
