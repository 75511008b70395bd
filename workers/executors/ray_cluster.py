"""A Ray cluster to work on: one on this machine that ends with the build, or one that runs already."""

import os
import socket
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")

import ray
import ray.exceptions

from tableverse_factory.core.errors import BuildError
from tableverse_factory.core.storage.files import redact_uri
from workers.executors.ray_address import host_and_port
from workers.sandbox.error_text import one_line

OBJECT_STORE_BYTES = 1024**3
KNOCK_S = 10.0


@dataclass(frozen=True, slots=True)
class Node:
    """A node of the cluster that is alive.

    Attributes:
        node_id: Ray's.
        name: Its address, for people.
        resources: What it has in all, by Ray's names; memory in bytes.
    """

    node_id: str
    name: str
    resources: Mapping[str, float]


def alive_nodes() -> tuple[Node, ...]:
    """The nodes that can be given work now, once connected."""
    alive = (node for node in ray.nodes() if node["Alive"])
    return tuple(Node(node["NodeID"], node["NodeManagerAddress"], dict(node["Resources"])) for node in alive)


def capacity_of(nodes: Sequence[Node], workers: int | None) -> dict[str, float]:
    """What the nodes have together of each resource; of their CPUs no more than `workers`, where that is given."""
    have: Counter[str] = Counter()
    for node in nodes:
        have.update(node.resources)
    return {**have, "CPU": min(have["CPU"], workers)} if workers is not None else dict(have)


def check_workers(workers: int | None, nodes: Sequence[Node]) -> None:
    """Refuses more workers than there are CPUs.

    Raises:
        BuildError: saying what is asked for and what is there.
    """
    have = capacity_of(nodes, None).get("CPU", 0.0)
    if workers is not None and workers > have:
        raise BuildError(
            f"{workers} workers need {workers} CPUs and the cluster has {have:g}: give --workers {max(1, int(have))}"
        )


def connect(address: str | None) -> None:
    """Starts Ray on this machine, quietly and without a dashboard, or joins the cluster at `address`.

    Raises:
        BuildError: if it does not answer.
    """
    if address not in (None, "auto"):
        _check_reachable(str(address))
    local: dict[str, Any] = {"include_dashboard": False, "object_store_memory": OBJECT_STORE_BYTES}
    try:
        ray.init(
            address=address or "local",
            configure_logging=True,
            logging_level="ERROR",
            log_to_driver=False,
            **({} if address else local),
        )
    except (ConnectionError, RuntimeError, ValueError, ray.exceptions.RayError) as error:
        where = f"the Ray cluster at {redact_uri(address)}" if address else "Ray on this machine"
        raise BuildError(f"{where} cannot be reached: {describe_loss(error)}") from error


def _check_reachable(address: str) -> None:
    """Knocks at the door first: `ray.init` waits for minutes, deaf to signals, where nobody answers."""
    try:
        socket.create_connection(host_and_port(address), timeout=KNOCK_S).close()
    except (OSError, UnicodeError) as error:
        raise BuildError(f"the Ray cluster at {redact_uri(address)} cannot be reached: {error}") from error


def describe_loss(error: Exception) -> str:
    """What Ray says of a loss, in one short line."""
    return one_line(f"{type(error).__name__}: {error}")[:300]
