"""Ray actor that runs any stages of any pipeline, in its own sandbox."""

import ray
import ray.util

from schemas.codec import decode, encode
from schemas.work import SandboxSetup, StageChain, StageChainReport
from workers.executors.preflight import NodeExpectation, find_local_problem
from workers.sandbox.parent import Sandbox


class StageActor:
    """Runner of stages; its pool only decides which resources it holds."""

    def __init__(self, setup: bytes) -> None:
        """Decode a `SandboxSetup`."""
        decoded: SandboxSetup = decode(setup)
        self._sandbox = Sandbox(decoded)

    def check(self, expected: NodeExpectation | None) -> str:
        """Check that this node would give the same bytes as the others; returns the problem, or nothing."""
        if expected is None:
            return ""
        return find_local_problem(ray.util.get_node_ip_address(), ray.get_runtime_context().get_node_id(), expected)

    def run(self, chains: bytes, *items: bytes) -> tuple[bytes, ...]:
        """Run encoded chains on their inputs; returns the encoded reports, then the output of each chain."""
        decoded: tuple[StageChain, ...] = decode(chains)
        reports: list[StageChainReport] = []
        values: list[bytes] = []
        for chain, item in zip(decoded, items, strict=True):
            report, value = self._sandbox.run(chain, item)
            reports.append(report)
            values.append(value)
        return encode(tuple(reports)), *values
