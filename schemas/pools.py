"""Resources of the actors of each pool on a cluster. They decide the speed of a build, never its bytes."""

from typing import Annotated

from pydantic import Field, model_validator

from schemas.config import Section

RAY_NAMES = ("CPU", "GPU", "memory", "object_store_memory")  # resources that Ray takes by keywords of their own
STEPS = 10_000  # of a resource that Ray tells apart

Amount = Annotated[float, Field(ge=0.0, le=1e6, allow_inf_nan=False)]
ResourceName = Annotated[str, Field(max_length=100, pattern=r"^[A-Za-z0-9_.:/-]+$")]


class PoolSpec(Section):
    """Pool of actors. Pools with the same resources share their actors."""

    cpus: Amount = 1.0
    """CPUs that an actor holds; a fraction if it mostly waits for a model server."""
    gpus: Amount = 0.0
    """GPUs that an actor holds: a fraction if several share one, else a whole number."""
    memory_mb: Annotated[int, Field(ge=0)] = 0
    """Memory that an actor reserves in Ray, so that nodes are not overfilled; 0 for none [MB]."""
    resources: dict[ResourceName, Amount] = Field(default_factory=dict)
    """Custom resources of the cluster, by name."""
    min: Annotated[int, Field(ge=0, le=100_000)] = 0
    """Actors that are started at once and kept, since models take long to load."""
    max: Annotated[int | None, Field(ge=1, le=100_000)] = None
    """Actors at most; null for as many as the cluster holds."""
    recycle_after: Annotated[int, Field(ge=0)] = 0
    """Scenes after which an actor is replaced, against leaks of native code; 0 for never."""

    @model_validator(mode="after")
    def _check_bounds(self) -> "PoolSpec":
        if self.gpus > 1 and self.gpus != int(self.gpus):
            raise ValueError(f"gpus {self.gpus:g}: give a fraction of one GPU, or a whole number of them")
        if taken := sorted({*RAY_NAMES} & {*self.resources}):
            raise ValueError(f"resources {', '.join(taken)}: give cpus, gpus or memory_mb")
        for name, amount in {"cpus": self.cpus, "gpus": self.gpus, **self.resources}.items():
            if abs(amount * STEPS - round(amount * STEPS)) > 1e-6 * max(1.0, amount * STEPS):
                raise ValueError(f"{name} {amount:g}: Ray counts in steps of {1 / STEPS:g}")
        if self.max is not None and self.min > self.max:
            raise ValueError(f"min {self.min} is more than max {self.max}")
        if not (self.cpus or self.gpus or self.memory_mb or any(self.resources.values())):
            raise ValueError(
                "cpus is 0, and no gpus, memory_mb or resources are above 0: an actor would hold nothing; "
                "leave cpus out for 1, or give one of the others"
            )
        return self

    def needs(self) -> dict[str, float]:
        """Return the resources of one actor by Ray's names; memory in bytes."""
        asked = {"CPU": self.cpus, "GPU": self.gpus, "memory": self.memory_mb * 1e6, **self.resources}
        return {name: amount for name, amount in asked.items() if amount}


class Pools(Section):
    """Pools of the pipeline, one per kind of work."""

    perception: PoolSpec = PoolSpec()
    """observe, read_layout, perceive"""
    geometry: PoolSpec = PoolSpec()
    """place, rectify"""
    physics: PoolSpec = PoolSpec()
    """settle, export"""
    curation: PoolSpec = PoolSpec()
    """curate"""
    trajectories: PoolSpec = PoolSpec()
    """trajectories"""
