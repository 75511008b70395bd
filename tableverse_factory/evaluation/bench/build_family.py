"""The processes of a build, found from outside by their command lines, and the choice of one to kill."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import psutil

DRIVER, ACTOR, SANDBOX = "driver", "actor", "sandbox"
MAX_SANDBOX_KILLS = 2  # of one actor; at more in one call, its scene fails as lost
_WORDS = {"ray::StageActor": ACTOR, "workers.sandbox.child": SANDBOX}


@dataclass(frozen=True, slots=True)
class Member:
    """A process of a build."""

    kind: str  # `driver`, `actor` or `sandbox`
    process: psutil.Process
    parent: int  # number of the process above it, the actor of a sandbox

    def kill(self) -> bool:
        """Kill it with SIGKILL; False if it has ended before."""
        try:
            self.process.kill()
        except psutil.NoSuchProcess:
            return False
        return True


def list_family(driver: int) -> list[Member]:
    """List the driver, its actors and their sandboxes; nothing if the driver has ended."""
    try:
        first = psutil.Process(driver)
        members, below = [Member(DRIVER, first, first.ppid())], first.children(recursive=True)
    except psutil.NoSuchProcess:
        return []
    for process in below:
        try:
            command, parent = " ".join(process.cmdline()), process.ppid()
        except (psutil.NoSuchProcess, psutil.ZombieProcess):
            continue
        kind = next((kind for word, kind in _WORDS.items() if word in command), None)
        if kind is not None:
            members.append(Member(kind, process, parent))
    return members


def choose_victim(members: Sequence[Member], hits: Counter[int], rng: np.random.Generator) -> Member | None:
    """Choose a process of a random kind; None if there is none.

    `hits` counts the killed sandboxes of each actor: beyond `MAX_SANDBOX_KILLS` its sandboxes are left alone, so no
    scene is hit more often within one call.
    """
    allowed = [m for m in members if m.kind != SANDBOX or hits[m.parent] < MAX_SANDBOX_KILLS]
    if not allowed:
        return None
    kinds = sorted({member.kind for member in allowed})
    kind = kinds[rng.integers(len(kinds))]
    of_kind = [member for member in allowed if member.kind == kind]
    victim = of_kind[rng.integers(len(of_kind))]
    if kind == SANDBOX:
        hits[victim.parent] += 1
    return victim
