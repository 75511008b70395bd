"""Hash of this package's sources: a checkout changes them under the same version."""

from functools import cache
from pathlib import Path

from schemas.identity import content_hash

_ROOT = Path(__file__).resolve().parents[2]
_PACKAGES = ("schemas", "tableverse_factory", "workers")


@cache
def compute_source_hash() -> str:
    """Hash the sources as they were when this process first asked."""
    sources = (path for package in _PACKAGES for path in sorted((_ROOT / package).rglob("*.py")))
    parts = (part for path in sources for part in (str(path.relative_to(_ROOT)).encode(), path.read_bytes()))
    return content_hash(*parts)[:12]
