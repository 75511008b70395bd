"""Hash of this package's sources: a checkout changes them under the same version."""

from functools import cache
from pathlib import Path

from schemas.identity import content_hash

_ROOT = Path(__file__).resolve().parents[2]
_SUFFIXES = (".py", ".sha256")  # the latter of weights, which are checked against it where they are loaded
_PACKAGES = ("schemas", "tableverse_factory", "workers")


@cache
def compute_source_hash() -> str:
    """Hash the sources, and the digests of shipped weights, as they were when this process first asked."""
    files = (path for package in _PACKAGES for path in sorted((_ROOT / package).rglob("*")))
    sources = (path for path in files if path.suffix in _SUFFIXES)
    parts = (part for path in sources for part in (str(path.relative_to(_ROOT)).encode(), path.read_bytes()))
    return content_hash(*parts)[:12]
