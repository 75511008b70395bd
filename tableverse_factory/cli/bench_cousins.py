"""`tableverse bench cousins`: how many cousins end as done, what they cost, and how they differ."""

from dataclasses import asdict
from typing import Annotated

import typer

from tableverse_factory.cli.options import AsJson, Jobs
from tableverse_factory.cli.tables import print_figures, print_json


def bench_cousins(
    out: Annotated[str, typer.Argument(metavar="DEST", help="A dataset that `tableverse cousins` made.")],
    most: Annotated[int | None, typer.Option(min=1, help="Most families to compare, the first ones.")] = None,
    jobs: Jobs = None,
    as_json: AsJson = False,
) -> None:
    """Measure cousins: share done, CPU time, and by family how far layouts and relations differ.

    The layout distance of two scenes is the mean distance between the places of the things that both have; their
    relations are those of tasks (sides, next to, on, in), and differ by the share that only one of them has.

    Example: `tableverse cousins out out-cousins && tableverse bench cousins out-cousins`
    """
    import numpy as np

    from tableverse_factory.core.process_pool import count_available_cpus
    from tableverse_factory.evaluation.bench.cousins import measure_cousins

    score = measure_cousins(out, most, jobs or count_available_cpus())
    if as_json:
        print_json(asdict(score))
        return
    rows = [
        (
            *(its.parent, f"{its.done}/{its.of}", f"{100 * its.from_parent_m:.1f}", f"{100 * its.layout_m:.1f}"),
            *(f"{100 * its.least_layout_m:.1f}", f"{its.relations:.2f}", its.alike),
        )
        for its in score.families
    ]
    names = ("from parent cm", "apart cm", "least cm", "relations", "alike")
    print_figures(
        ("family", "done", *names),
        rows,
        "medians over the cousins of a family; alike: pairs within 1 cm and 5 % of the relations",
    )
    print(f"done: {score.done} of {score.of} ({score.done / score.of:.1%})")
    rest = f"{score.cpu_median_s:.2f} median, {score.cpu_p95_s:.2f} p95, {score.cpu_max_s:.2f} most"
    print(f"CPU s of a cousin: {score.cpu_mean_s:.2f} mean, {rest}".replace("nan", "–"))
    print("changes: " + ", ".join(f"{count} {kind}" for kind, count in score.changes))
    layouts = [its.layout_m for its in score.families if not np.isnan(its.layout_m)]
    relations = [its.relations for its in score.families if not np.isnan(its.relations)]
    if layouts:
        print(f"two cousins, median: {100 * np.median(layouts):.1f} cm, {np.median(relations):.0%} of the relations")
    for reason, count in score.lost:
        print(f"lost: {count} {reason}")
