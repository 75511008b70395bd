"""The one actor class there is: any stages of any line, each call in the actor's own sandbox."""

import ray
import ray.util

from schemas.codec import decode, encode
from schemas.work import SandboxSetup, StageChain, StageChainReport
from workers.executors.preflight import Expected, problem_here
from workers.sandbox.parent import Sandbox


class StageActor:
    """Runs whatever it is told; its pool only says which resources it holds."""

    def __init__(self, setup: bytes) -> None:
        """Takes an encoded `SandboxSetup`."""
        decoded: SandboxSetup = decode(setup)
        self._sandbox = Sandbox(decoded)

    def check(self, expected: Expected | None) -> str:
        """Why this node would not give the bytes of the others, in words; empty where nothing is amiss."""
        if expected is None:
            return ""
        return problem_here(ray.util.get_node_ip_address(), ray.get_runtime_context().get_node_id(), expected)

    def run(self, chains: bytes, *items: bytes) -> tuple[bytes, ...]:
        """Encoded chains and the input of each; the encoded reports, and what each chain gave."""
        decoded: tuple[StageChain, ...] = decode(chains)
        reports: list[StageChainReport] = []
        values: list[bytes] = []
        for chain, item in zip(decoded, items, strict=True):
            report, value = self._sandbox.run(chain, item)
            reports.append(report)
            values.append(value)
        return encode(tuple(reports)), *values
