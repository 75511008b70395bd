"""Trajectory of a dataset: its row, and the arrays of its motion."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from tableverse_factory.core.errors import InputError
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.dataset.trajectory_files import check_digest

if TYPE_CHECKING:
    from tableverse_factory.robotics.execution.arrays import Recording


@dataclass(frozen=True, slots=True)
class Trajectory:
    """How one task of a scene was tried; `row` is its row of trajectories/ (`schemas.tables.TRAJECTORIES`)."""

    row: Mapping[str, Any]
    _data: bytes | None = field(repr=False)

    @property
    def success(self) -> bool:
        """Whether it succeeded in simulation."""
        return bool(self.row["success"])

    def recording(self) -> "Recording":
        """Decode the commands to the robot and the states that followed, sample by sample.

        Raises:
            InputError: if no motion was executed, with the reason; `bad_arrays` if its file is not the one written.
        """
        from tableverse_factory.robotics.execution.arrays import decode_recording

        if self._data is None:
            why = ": ".join(sanitize_line(str(self.row[key]), 300) for key in ("reason", "detail") if self.row[key])
            raise InputError(f"{self.row['task_id']} has no motion: {why}")
        return decode_recording(check_digest(self._data, self.row), self.row["arrays"])
