"""Weights that come with the package: whole, or refused."""

import hashlib
from pathlib import Path

from tableverse_factory.core.errors import WeightsError


def read_shipped(path: Path, digest: Path) -> bytes:
    """Read a file of this package whose SHA-256 stands in `digest`.

    Raises:
        WeightsError: if either file is missing, or they differ.
    """
    try:
        data, wanted = path.read_bytes(), digest.read_text().strip()
    except OSError as error:
        raise WeightsError(f"weights of the package are missing: {error}; install the package again") from error
    found = hashlib.sha256(data).hexdigest()
    if found != wanted:
        raise WeightsError(
            f"{path} is damaged: its SHA-256 begins with {found[:12]}, not {wanted[:12]}; install the package again"
        )
    return data
