"""Actors that a cluster holds, and whether the pools fit: one that fits on no node would wait for ever, silently."""

import math
from collections.abc import Mapping, Sequence

from schemas.pools import PoolSpec
from tableverse_factory.core.errors import BuildError
from workers.executors.ray_cluster import Node
from workers.executors.schedule import PoolLimits

_OPTION_BY_RESOURCE = {"CPU": "cpus", "GPU": "gpus", "memory": "memory_mb"}
_ROUNDING = 1e-9


def compute_pool_limits(spec: PoolSpec, nodes: Sequence[Node], workers: int | None) -> PoolLimits:
    """Compute the limits of a pool; with `workers`, at most as many actors that hold no CPU: no sum bounds these."""
    needs = spec.needs()
    room = sum(count_actors(node.resources, needs) for node in nodes)
    bounds = (spec.max, workers if spec.cpus == 0.0 else None)
    most = min([room, *(bound for bound in bounds if bound is not None)])
    return PoolLimits(needs, spec.min, most, recycle_after=spec.recycle_after)


def check_pools(
    specs: Mapping[str, PoolSpec], nodes: Sequence[Node], capacity: Mapping[str, float], workers: int | None = None
) -> None:
    """Refuse pools that the cluster, or the part of it that `workers` names, could never hold.

    Each pool must fit with one actor, and with its `min` of actors, on single nodes (future ones of an autoscaler do
    not count); all of these together must not exceed the capacity. If the sum fits but not all actors at once, the
    build runs nevertheless: it retires idle actors, even those of `min`, to make room for others.
    """
    for name, spec in specs.items():
        needs = spec.needs()
        room = sum(count_actors(node.resources, needs) for node in nodes)
        if room == 0:
            raise BuildError(_explain_misfit(name, needs, nodes))
        if room < spec.min:
            raise BuildError(
                f"pool {name} wants at least {spec.min} actors with {_format_amounts(needs)} each and the cluster has "
                f"room for {room}: set min of {name} to {room} in --pools, or start more nodes"
            )
        if workers is not None and spec.cpus == 0.0 and workers < spec.min:
            raise BuildError(
                f"pool {name} wants at least {spec.min} actors and --workers is {workers}: set min of {name} to "
                f"{workers} in --pools, or give --workers {spec.min}"
            )
    _check_together(specs, capacity)


def count_actors(resources: Mapping[str, float], needs: Mapping[str, float]) -> int:
    """Count the actors that a node holds; a fraction of a GPU never spans two of them."""
    return min(_count_by_resource(resources.get(name, 0.0), name, need) for name, need in needs.items())


def _count_by_resource(have: float, name: str, need: float) -> int:
    if name == "GPU" and need < 1.0:
        return int(have + _ROUNDING) * math.floor(1.0 / need + _ROUNDING)
    return math.floor(have / need + _ROUNDING)


def _explain_misfit(name: str, needs: Mapping[str, float], nodes: Sequence[Node]) -> str:
    most = {resource: max((node.resources.get(resource, 0.0) for node in nodes), default=0.0) for resource in needs}
    lacking = [resource for resource, need in needs.items() if _count_by_resource(most[resource], resource, need) == 0]
    if not lacking:
        return (
            f"pool {name} wants {_format_amounts(needs)} on one node, and no node has all of it: "
            f"{_format_nodes(nodes, needs)}. Lower {_format_options(needs)} of {name} in --pools, "
            "or start a larger node"
        )
    wanted = _format_amounts({resource: needs[resource] for resource in lacking})
    had = _format_amounts({resource: most[resource] for resource in lacking})
    return (
        f"pool {name} wants {wanted} on one node and the largest node has {had}: "
        f"lower {_format_options(lacking)} of {name} in --pools, or start a node that has it"
    )


def _check_together(specs: Mapping[str, PoolSpec], capacity: Mapping[str, float]) -> None:
    asked: dict[str, float] = {}
    for spec in specs.values():
        for resource, need in spec.needs().items():
            asked[resource] = asked.get(resource, 0.0) + max(1, spec.min) * need
    for resource, amount in asked.items():
        have = capacity.get(resource, 0.0)
        if amount > have + _ROUNDING * max(1.0, have):
            raise BuildError(
                f"the pools {', '.join(specs)} together want {_format_amount(resource, amount)} for their fewest "
                f"actors and the build may use {_format_amount(resource, have)}: lower min or what an actor holds "
                "in --pools, give more --workers, or start more nodes"
            )


def _format_nodes(nodes: Sequence[Node], needs: Mapping[str, float]) -> str:
    shown = [f"{n.name} has {_format_amounts({r: n.resources.get(r, 0.0) for r in needs})}" for n in nodes[:4]]
    return "; ".join([*shown, *([f"and {len(nodes) - 4} more"] if len(nodes) > 4 else [])])


def _format_options(resources: Mapping[str, float] | Sequence[str]) -> str:
    return " or ".join(_OPTION_BY_RESOURCE.get(resource, f"resources.{resource}") for resource in resources)


def _format_amounts(amounts: Mapping[str, float]) -> str:
    return " and ".join(_format_amount(resource, amount) for resource, amount in amounts.items())


def _format_amount(resource: str, amount: float) -> str:
    if resource == "memory":
        return f"{amount / 1e6:.0f} MB of memory"
    unit = {"CPU": "CPU", "GPU": "GPU"}.get(resource, f"of {resource}")
    return f"{amount:g} {unit}{'' if amount == 1 or resource not in _OPTION_BY_RESOURCE else 's'}"
