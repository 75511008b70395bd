"""The one actor class there is: any stages of any line, each call in the actor's own sandbox."""

from schemas.codec import decode, encode
from schemas.work import Chain, ChainReport, SandboxSetup
from workers.sandbox import Sandbox


class StageActor:
    """Runs whatever it is told; its pool only says which resources it holds."""

    def __init__(self, setup: bytes) -> None:
        """Takes an encoded `SandboxSetup`."""
        decoded: SandboxSetup = decode(setup)
        self._sandbox = Sandbox(decoded)

    def run(self, chains: bytes, *items: bytes) -> tuple[bytes, ...]:
        """Encoded chains and the input of each; the encoded reports, and what each chain gave."""
        decoded: tuple[Chain, ...] = decode(chains)
        reports: list[ChainReport] = []
        values: list[bytes] = []
        for chain, item in zip(decoded, items, strict=True):
            report, value = self._sandbox.run(chain, item)
            reports.append(report)
            values.append(value)
        return encode(tuple(reports)), *values
