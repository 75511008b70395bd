"""The one actor class there is: any stage of any line, each call in the actor's own sandbox."""

from schemas.codec import decode, encode
from schemas.work import SandboxSetup, StageCall
from workers.sandbox import Sandbox


class StageActor:
    """Runs whatever stage it is told; its pool only says which resources it holds."""

    def __init__(self, setup: bytes) -> None:
        """Takes an encoded `SandboxSetup`; the child starts with the first call."""
        decoded: SandboxSetup = decode(setup)
        self._sandbox = Sandbox(decoded)

    def run(self, call: bytes, item: bytes) -> tuple[bytes, bytes]:
        """An encoded `StageCall` and its input; an encoded `StageReport` and the next record."""
        decoded: StageCall = decode(call)
        report, value = self._sandbox.run(decoded, item)
        return encode(report), value
