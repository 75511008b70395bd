"""What a worker does with a chain: reads its input, runs the stages in the sandbox, keeps what each of them gave."""

from collections.abc import Callable

from schemas.work import Chain, ChainReport, SandboxSetup, StageReport
from tableverse_factory.storage import place_of
from workers.records import Records
from workers.sandbox import Sandbox


class Worker:
    """One sandbox, and the records that its stages leave."""

    def __init__(self, setup: SandboxSetup) -> None:
        """The sandbox's child starts with the first stage."""
        self._sandbox = Sandbox(setup)
        self._records = Records(place_of(setup.records_dir))

    def run(self, chain: Chain, item: bytes, watch: Callable[[], None] = lambda: None) -> tuple[ChainReport, bytes]:
        """Runs stages until one is not done.

        Args:
            chain: Which, on which scene.
            item: The encoded input; not looked at where the chain names a record.
            watch: Called every few milliseconds; what it raises ends the chain and the child.

        Returns:
            The reports, and the encoded output of the last stage (empty unless it is done).

        Raises:
            BuildError: if no child can be started at all, or a record cannot be written.
        """
        if chain.input_record:
            kept = self._records.read(chain.input_record)
            if kept is None:
                return ChainReport((), input_lost=True), b""
            item = kept
        reports: list[StageReport] = []
        for call, record in zip(chain.calls, chain.output_records, strict=True):
            report, item = self._sandbox.run(call, item, watch)
            reports.append(report)
            if report.outcome is not None:
                break
            if record:
                self._records.write(record, item)
        return ChainReport(tuple(reports)), item

    def close(self) -> None:
        """Kills the child, at once."""
        self._sandbox.close()
