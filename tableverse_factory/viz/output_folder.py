"""Default folders of reports about a dataset."""

from pathlib import Path


def choose_destination(out: str, suffix: str) -> Path:
    """Return the default folder of a report: beside the dataset, whose own bytes stay as built."""
    path = Path(out.rstrip("/").rpartition("/")[2]) if "://" in out else Path(out).resolve()
    return path.with_name(f"{path.name}-{suffix}")
