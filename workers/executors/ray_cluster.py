"""Connection to a Ray cluster: one on this machine that ends with the build, or a running one."""

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
from workers.executors.ray_address import parse_host_port
from workers.sandbox.error_text import sanitize_error_text

_NO_RAY = (ConnectionError, RuntimeError, ValueError, ray.exceptions.RayError)
OBJECT_STORE_BYTES = 1024**3
CONNECT_TIMEOUT_S = 10.0


@dataclass(frozen=True, slots=True)
class Node:
    """A live node of the cluster."""

    node_id: str  # Ray's
    name: str  # its address
    resources: Mapping[str, float]  # totals by Ray's names; memory in bytes


def list_alive_nodes() -> tuple[Node, ...]:
    """List the live nodes of the connected cluster."""
    alive = (node for node in ray.nodes() if node["Alive"])
    return tuple(Node(node["NodeID"], node["NodeManagerAddress"], dict(node["Resources"])) for node in alive)


def sum_capacity(nodes: Sequence[Node], workers: int | None) -> dict[str, float]:
    """Sum the resources of the nodes; with `workers`, at most as many CPUs."""
    have: Counter[str] = Counter()
    for node in nodes:
        have.update(node.resources)
    return {**have, "CPU": min(have["CPU"], workers)} if workers is not None else dict(have)


def check_workers(workers: int | None, nodes: Sequence[Node]) -> None:
    """Refuse more workers than there are CPUs."""
    have = sum_capacity(nodes, None).get("CPU", 0.0)
    if workers is not None and workers > have:
        raise BuildError(
            f"{workers} workers need {workers} CPUs and the cluster has {have:g}: give --workers {max(1, int(have))}"
        )


def connect(address: str | None) -> None:
    """Start Ray on this machine, without a dashboard, or join the cluster at `address`."""
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
    except Exception as error:
        # A plain one is that of a node that does not start in time; of other types, what is none of Ray's is ours.
        if not isinstance(error, _NO_RAY) and type(error) is not Exception:
            raise
        where, remedy = f"the Ray cluster at {redact_uri(address or '')} cannot be reached", ""
        if not address:
            where, remedy = "Ray does not start on this machine", "; --executor local does without it"
        raise BuildError(f"{where}: {describe_loss(error)}{remedy}") from error


def _check_reachable(address: str) -> None:
    """Test the connection, because `ray.init` waits for minutes, deaf to signals, if there is no answer."""
    try:
        socket.create_connection(parse_host_port(address), timeout=CONNECT_TIMEOUT_S).close()
    except (OSError, UnicodeError) as error:
        raise BuildError(f"the Ray cluster at {redact_uri(address)} cannot be reached: {error}") from error


def describe_loss(error: Exception) -> str:
    """Describe an error of Ray in one short line."""
    return sanitize_error_text(f"{type(error).__name__}: {error}")[:300]
