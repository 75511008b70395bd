"""What a stage may lean on besides its input: the models behind their doors, and the cache of convex pieces."""

from dataclasses import dataclass, field
from pathlib import Path

from schemas.config import AskingConfig
from tableverse_factory.models.remote.cost_meter import Meter


@dataclass(frozen=True, slots=True)
class Services:
    """Made once per process, before the first item; results never depend on what is in a cache.

    Attributes:
        cache_dir: Content-addressed cache on this machine, shared by processes; safe to delete at any time.
        asking: How fast models behind an address are asked.
        meter: Counts what that costs.
    """

    cache_dir: Path
    asking: AskingConfig = field(default_factory=AskingConfig)
    meter: Meter = field(default_factory=Meter)
