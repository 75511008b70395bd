"""`tableverse estimate`: cost of a larger build, from the timings of this one."""

from collections.abc import Callable
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

from schemas.error_text import describe_validation_error
from tableverse_factory.cli.options import AsJson, BuiltOut, Pools
from tableverse_factory.cli.tables import make_table, print_json
from tableverse_factory.core.errors import ConfigError
from tableverse_factory.core.text import sanitize_line

if TYPE_CHECKING:
    from schemas.config import Config
    from tableverse_factory.core.storage.files import StoragePath
    from tableverse_factory.dataset.cost_estimate import ClusterSize, CostEstimate, IntervalEstimate


def estimate(
    out: BuiltOut,
    scenes: Annotated[int, typer.Option(min=1, metavar="N", help="Rows of the manifest that is planned.")],
    cluster: Annotated[
        str | None, typer.Option(metavar="cpus=N,gpus=N", help="Where it will run: gives wall time.")
    ] = None,
    pools: Pools = None,
    prices: Annotated[
        list[str] | None,
        typer.Option(
            "--price",
            metavar="NAME=NUMBER",
            help="cpu_hour, gpu_hour, gb_month, input_mtok or output_mtok = NUMBER; may repeat.",
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Estimate the cost of a larger build from this one.

    CPU and GPU hours, storage, tokens, wall time and cost, each with its interval. The estimate uses all scenes that
    are accounted for in OUT, dropped and failed ones included, and needs at least 50. docs/monitoring.md explains the
    intervals.

    Example: `tableverse estimate out --scenes 100000 --cluster cpus=64 --price cpu_hour=0.04`
    """
    from tableverse_factory.core.pools_file import load_pools
    from tableverse_factory.core.storage.files import parse_path
    from tableverse_factory.dataset.cost_estimate import LEVEL, PRICES, parse_amounts
    from tableverse_factory.dataset.cost_estimate import estimate_cost as compute
    from tableverse_factory.pipeline import WITH_TRAJECTORIES
    from workers.progress.stage_costs import collect_measurements

    stated = _parse_cluster(cluster)
    given = parse_amounts(prices or [], PRICES, "--price")
    place = parse_path(out)
    pool_of = {stage.name: stage.pool for line in WITH_TRAJECTORIES.values() for stage in line}
    timings = collect_measurements(place, pool_of)
    found = compute(timings, scenes, load_pools(pools, _read_config(place)), stated, given)
    if as_json:
        print_json({"level": LEVEL, **asdict(found)})
    else:
        _print_estimate(found, stated)


def _read_config(place: "StoragePath") -> "Config":
    from pydantic import ValidationError

    from schemas.config import Config
    from tableverse_factory.run_record import read_run

    path = place / "run.json"
    try:
        return Config.model_validate(read_run(path).get("config"))
    except ValidationError as error:
        raise ConfigError(f"{path}: {describe_validation_error(error)}: it was built by another version") from None


def _parse_cluster(text: str | None) -> "ClusterSize | None":
    from tableverse_factory.dataset.cost_estimate import ClusterSize, parse_amounts

    if text is None:
        return None
    amounts = parse_amounts(text.split(","), ("cpus", "gpus"), "--cluster")
    if amounts.get("cpus", 0.0) <= 0.0:
        raise ConfigError(f"--cluster {text[:80]}: say how many CPUs, e.g. cpus=64,gpus=4")
    return ClusterSize(**amounts)


def _print_estimate(found: "CostEstimate", cluster: "ClusterSize | None") -> None:
    from rich.console import Console

    from workers.progress.table import format_seconds

    console = Console(markup=False)
    table = make_table("", figures=("estimate", "from", "to"))
    for name, cells in _make_rows(found, cluster):
        table.add_row(name, *cells)
    console.print(f"{found.scenes} scenes, estimated from {found.measured}", highlight=False)
    console.print(table)
    stages = make_table("stage", figures=("CPU", "wall", "from", "to"), title="per scene that enters the build")
    for name, (cpu, wall) in found.stages.items():
        stages.add_row(name, *(format_seconds(value) for value in (cpu.value, wall.value, wall.low, wall.high)))
    console.print(stages)
    if found.bottleneck:
        console.print(f"the wall time is decided by {found.bottleneck}", highlight=False)
    if found.waiting_share > 0.0:
        console.print(f"{found.waiting_share:.0%} of the stages' wall time is waiting, not CPU time", highlight=False)
    for note in found.notes:
        console.print(f"note: {sanitize_line(note, 200)}", highlight=False)


def _make_rows(found: "CostEstimate", cluster: "ClusterSize | None") -> list[tuple[str, tuple[str, ...]]]:
    from workers.progress.table import format_bytes, format_duration

    rows = [("CPU-hours used", _format_range(found.cpu_hours)), ("CPU-hours held", _format_range(found.cpu_hours_held))]
    if found.gpu_hours.value:
        rows.append(("GPU-hours held", _format_range(found.gpu_hours)))
    for name, size in found.storage.items():
        rows.append((name, _format_range(size, format_bytes)))
    for name, tokens in (("tokens read", found.input_tokens), ("tokens written", found.output_tokens)):
        if tokens.value:
            rows.append((name, _format_range(tokens)))
    where = "" if cluster is None else f"{cluster.cpus:g} CPUs" + (f", {cluster.gpus:g} GPUs" if cluster.gpus else "")
    for name, hours in ((f"wall time on {where}", found.wall_hours), ("  without waiting", found.least_wall_hours)):
        if hours is not None:
            rows.append((name, _format_range(hours, lambda value: format_duration(value * 3600))))
    rows += [(f"cost of {name}", _format_range(cost)) for name, cost in found.costs.items()]
    return rows


def _format_number(value: float) -> str:
    """Format three significant digits, without exponents."""
    if value >= 100.0 or value == 0.0:
        return f"{value:,.0f}"
    return f"{value:.1f}" if value >= 10.0 else f"{value:.2f}" if value >= 1.0 else f"{value:.3g}"


def _format_range(figure: "IntervalEstimate", as_text: Callable[[float], str] = _format_number) -> tuple[str, ...]:
    return as_text(figure.value), as_text(figure.low), as_text(figure.high)
