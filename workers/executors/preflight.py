"""Preflight of the nodes of a cluster: same versions, visible inputs, shared folder."""

import secrets
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

import ray
import ray.exceptions
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from tableverse_factory.core.errors import BuildError, StoreError
from tableverse_factory.core.storage.files import (
    StoragePath,
    parse_path,
    read_whole,
    remove,
    resolve_filesystem,
    write_atomic,
)
from tableverse_factory.core.storage.untrusted import find_type
from tableverse_factory.run_record import collect_versions
from workers.executors.ray_cluster import Node
from workers.sandbox.error_text import sanitize_error_text

T = TypeVar("T")

PROBE_TIMEOUT_S = 120.0
SAMPLED_INPUTS = 16
_MAX_SHOWN = 4


@dataclass(frozen=True, slots=True)
class NodeReport:
    """Result of the probe of a node."""

    node: str
    versions: Mapping[str, str]  # of Python, the packages that decide bytes, and our own code
    missing: tuple[str, ...]  # inputs that it cannot see
    token: str  # content of the token file; empty if it cannot read it


def check_nodes(nodes: Sequence[Node], inputs: Sequence[str], shared: StoragePath) -> None:
    """Check that every node computes the same as this machine, sees a sample of the inputs, and reaches `shared`."""
    sampled = sample_inputs(inputs)
    visible = find_visible_inputs(sampled)
    if sampled and not visible:
        raise BuildError(
            f"none of {len(sampled)} inputs tried can be seen from here, the head of the build, {sampled[0]} first: "
            "put them where the cluster reaches them, and make the manifest again from there"
        )
    with write_shared_token(shared) as (place, token):
        answers = probe_nodes(nodes, visible, place)
    check_versions(collect_versions(), answers)
    check_shared_folder(shared, token, answers)
    check_inputs(len(visible), answers)


def sample_inputs(inputs: Sequence[T]) -> tuple[T, ...]:
    """Select at most `SAMPLED_INPUTS` of the inputs, spread evenly."""
    step = max(1, -(-len(inputs) // SAMPLED_INPUTS))
    return tuple(inputs[::step])


def find_visible_inputs(inputs: Collection[str]) -> tuple[str, ...]:
    """Select the inputs that this machine can see; scenes of the others are dropped wherever they run."""
    return tuple(uri for uri in inputs if _is_visible(uri))


@contextmanager
def write_shared_token(folder: StoragePath) -> Iterator[tuple[StoragePath, str]]:
    """Write a random token into the folder for the time of the block; yields its path and the token."""
    place, token = folder / f"preflight-{secrets.token_hex(8)}", secrets.token_hex(16)
    write_atomic(place, token.encode())
    try:
        yield place, token
    finally:
        remove(place)


def probe_nodes(nodes: Sequence[Node], inputs: Sequence[str], token: StoragePath) -> list[NodeReport]:
    """Probe the nodes; those that are lost meanwhile are left out, like any node lost later."""
    probe: Any = ray.remote(num_cpus=0, max_retries=0)(probe_node)
    pending = {
        probe.options(scheduling_strategy=NodeAffinitySchedulingStrategy(node.node_id, soft=False)).remote(
            node.name, tuple(inputs), str(token)
        ): node
        for node in nodes
    }
    ready, late = ray.wait(list(pending), num_returns=len(pending), timeout=PROBE_TIMEOUT_S)
    if late:
        names = _abbreviate(sorted(pending[reference].name for reference in late))
        raise BuildError(f"no answer from {names} within {PROBE_TIMEOUT_S:g} s: look at `ray status`, or take them out")
    return [answer for reference in ready if (answer := _collect_report(reference, pending[reference])) is not None]


def probe_node(name: str, inputs: Sequence[str], token: str) -> NodeReport:
    """Probe this machine; runs on the node."""
    missing = tuple(uri for uri in inputs if not _is_visible(uri))
    try:
        content = read_whole(parse_path(token)).decode()
    except StoreError:
        raise
    except OSError:
        content = ""
    return NodeReport(name, collect_versions(), missing, content)


@dataclass(frozen=True, slots=True)
class NodeExpectation:
    """Requirements of an actor on its node, for nodes that join after the start of the build."""

    versions: Mapping[str, str]  # of Python, packages and our own code
    inputs: tuple[str, ...]  # a sample of the manifest's
    checked: tuple[str, ...] = ()  # Ray's ids of the nodes that passed the preflight and need no second one


def make_expectation(inputs: Sequence[str], checked: Sequence[Node]) -> NodeExpectation:
    """Describe this machine as what later nodes must match."""
    visible = find_visible_inputs(sample_inputs(inputs))
    return NodeExpectation(collect_versions(), visible, tuple(node.node_id for node in checked))


def find_local_problem(node: str, node_id: str, expected: NodeExpectation) -> str:
    """Find why this machine would give other bytes; empty if it would not. A StoreError is no fault of its."""
    if node_id in expected.checked:
        return ""
    answer = probe_node(node, expected.inputs, "")
    try:
        check_versions(expected.versions, [answer])
        check_inputs(len(expected.inputs), [answer])
    except BuildError as error:
        return str(error)
    return ""


def check_versions(own: Mapping[str, str], answers: Sequence[NodeReport]) -> None:
    """Refuse nodes whose results could differ from this machine's."""
    for answer in answers:
        differing = [name for name in sorted({*own, *answer.versions}) if own.get(name) != answer.versions.get(name)]
        if differing:
            shown = _abbreviate([f"{name} {answer.versions.get(name)} (here {own.get(name)})" for name in differing])
            raise BuildError(
                f"node {answer.node} has other versions than the driver: {shown}. The same bytes are promised from "
                "every node: give all the same image, or install the same release with -c constraints.txt"
            )


def check_inputs(n_tried: int, answers: Sequence[NodeReport]) -> None:
    """Refuse nodes that cannot read the inputs."""
    for answer in answers:
        if answer.missing:
            raise BuildError(
                f"node {answer.node} does not see {len(answer.missing)} of {n_tried} inputs tried, among them "
                f"{answer.missing[0]}: put the inputs on a folder that every node mounts under the same path, or into "
                "an object store, and make the manifest again from there"
            )


def check_shared_folder(folder: StoragePath, token: str, answers: Sequence[NodeReport]) -> None:
    """Refuse nodes that see another folder under this name, or none."""
    failing = [answer.node for answer in answers if answer.token != token]
    if failing:
        raise BuildError(
            f"{_abbreviate(failing)} cannot read what was written to {folder}: give a folder that every node mounts "
            "under this path, or s3://bucket/prefix with credentials on every node"
        )


def _collect_report(reference: Any, node: Node) -> NodeReport | None:
    try:
        answer: NodeReport = ray.get(reference)
    except ray.exceptions.RayTaskError as error:
        if isinstance(error.cause, StoreError):
            raise BuildError(f"node {node.name}: {error.cause}") from None
        text = sanitize_error_text(f"{type(error.cause).__name__}: {error.cause}")[:300]
        raise BuildError(
            f"node {node.name} cannot do this work: {text}. "
            "Install the same tableverse-factory there, and let it read the inputs"
        ) from None
    except ray.exceptions.RayError:  # the node is gone: the build goes on with the others
        return None
    return answer


def _is_visible(uri: str) -> bool:
    """Whether a file or folder exists; web addresses are not requested."""
    if uri.startswith(("http://", "https://")):
        return True
    try:
        filesystem, path = resolve_filesystem(uri)
        return find_type(filesystem, path) != ""
    except StoreError:
        raise
    except (OSError, ValueError, ImportError):
        return False


def _abbreviate(names: Sequence[str]) -> str:
    more = f" and {len(names) - _MAX_SHOWN} more" if len(names) > _MAX_SHOWN else ""
    return ", ".join(names[:_MAX_SHOWN]) + more
