"""What a stage may lean on besides its input: the models behind their doors, and the cache of convex pieces."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True)
class Services:
    """Made once per process, before the first item; results never depend on what is in a cache.

    Attributes:
        cache_dir: Content-addressed cache on this machine, shared by processes; safe to delete at any time.
    """

    cache_dir: Path
