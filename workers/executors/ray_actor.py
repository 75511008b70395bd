"""Ray actor that runs any stages of any pipeline, in its own sandbox."""

from collections.abc import Iterator
from contextlib import contextmanager

import ray
import ray.util

from schemas.codec import decode, encode
from schemas.work import SandboxSetup, StageChain
from tableverse_factory.core.errors import BuildError
from tableverse_factory.core.storage.files import parse_path
from workers.executors.preflight import NodeExpectation, find_local_problem
from workers.executors.ray_cluster import describe_loss
from workers.sandbox.parent import Sandbox
from workers.state.commit import stage_shard


class WorkerError(Exception):
    """Error outside the sandbox, as on a machine without room in its temporary folder."""


class StageActor:
    """Runner of stages; its pool only decides which resources it holds."""

    def __init__(self, setup: bytes) -> None:
        """Decode a `SandboxSetup`."""
        decoded: SandboxSetup = decode(setup)
        self._sandbox, self._out = Sandbox(decoded), parse_path(decoded.records_dir).parent

    def check(self, expected: NodeExpectation | None) -> str:
        """Check that this node would give the same bytes as the others; returns the problem, or nothing."""
        if expected is None:
            return ""
        return find_local_problem(ray.util.get_node_ip_address(), ray.get_runtime_context().get_node_id(), expected)

    def run(self, chains: bytes) -> bytes:
        """Run encoded chains; returns their encoded reports."""
        with _wrap_errors():
            decoded: tuple[StageChain, ...] = decode(chains)
            return encode(tuple(self._sandbox.run(chain) for chain in decoded))

    def stage_shard(self, call: bytes) -> bytes:
        """Assemble a shard for its commit; takes an encoded `CommitCall`, returns an encoded `StagedShard`."""
        with _wrap_errors():
            return encode(stage_shard(self._out, decode(call)))


@contextmanager
def _wrap_errors() -> Iterator[None]:
    """Raise what does not stop the build as a `WorkerError` that names this node."""
    try:
        yield
    except BuildError:
        raise
    except Exception as error:
        raise WorkerError(f"node {ray.util.get_node_ip_address()}: {describe_loss(error)}") from error
