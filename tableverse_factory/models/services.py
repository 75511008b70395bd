"""Services that stages use besides their input: access to models, and the cache folder."""

from dataclasses import dataclass, field
from pathlib import Path

from schemas.config import AskingConfig
from tableverse_factory.models.remote.cost_meter import Meter


@dataclass(frozen=True, slots=True)
class Services:
    """Services of one process, made before the first item; results never depend on the content of a cache.

    Attributes:
        cache_dir: Content-addressed cache on this machine, shared by processes; safe to delete at any time.
        asking: Rate limits of requests to remote models.
        meter: Meter of their cost.
    """

    cache_dir: Path
    asking: AskingConfig = field(default_factory=AskingConfig)
    meter: Meter = field(default_factory=Meter)
