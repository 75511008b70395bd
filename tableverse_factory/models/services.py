"""Services that stages use besides their input: access to models, and the cache folder."""

from dataclasses import dataclass, field
from pathlib import Path

from schemas.config import AskingConfig
from tableverse_factory.models.remote.cost_meter import Meter


@dataclass(frozen=True, slots=True)
class Services:
    """Services of one process, made before the first item: a cache folder, rate limits and a meter of remote models.

    The cache is content-addressed, shared by processes, and safe to delete at any time; results never depend on it.
    """

    cache_dir: Path
    asking: AskingConfig = field(default_factory=AskingConfig)
    meter: Meter = field(default_factory=Meter)
