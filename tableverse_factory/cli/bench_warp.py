"""`tableverse bench warp`: MuJoCo Warp on scenes of a dataset."""

from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

from tableverse_factory.cli.options import AsJson, Jobs, ReadableOut
from tableverse_factory.cli.tables import print_figures, print_json

if TYPE_CHECKING:
    from tableverse_factory.evaluation.bench.warp import EngineAgreement, WarpSpeed


def bench_warp(
    out: ReadableOut,
    worlds: Annotated[
        str, typer.Option(metavar="N,N,…", help="Numbers of worlds whose speed is measured; empty for none.")
    ] = "1,16,256,4096",
    scenes: Annotated[int, typer.Option(min=1, max=100_000, help="Different scenes, spread evenly over OUT.")] = 16,
    seconds: Annotated[float, typer.Option(min=0.002, max=60.0, help="Simulated time of the agreement [s].")] = 5.0,
    exported: Annotated[
        bool, typer.Option("--exported", help="The scenes' own no-slip iterations and integrator, which cost more.")
    ] = False,
    device: Annotated[str | None, typer.Option(metavar="NAME", help="Of Warp: cuda:0, cpu, …")] = None,
    jobs: Jobs = None,
    as_json: AsJson = False,
) -> None:
    """Measure steps per second of MuJoCo Warp, and how far it agrees with MuJoCo: rest, drift and contacts.

    Different scenes are stepped in one batch, padded to the largest. Needs mujoco-warp; the first run compiles kernels
    for a minute or two.

    Example: `tableverse bench warp out --worlds 1,4 --scenes 4 --seconds 1 --device cpu`
    """
    import pyarrow.compute as pc

    from tableverse_factory.core.errors import InputError
    from tableverse_factory.core.process_pool import count_available_cpus
    from tableverse_factory.dataset.dataset import open_dataset
    from tableverse_factory.delivery.learning.warp import silence_warp
    from tableverse_factory.evaluation.bench.measurement import sample_evenly
    from tableverse_factory.evaluation.bench.warp import measure_agreement, measure_speed

    silence_warp()
    counts = [int(word) for word in worlds.split(",") if word.strip().isdigit() and int(word) > 0]
    if len(counts) != len([word for word in worlds.split(",") if word.strip()]):
        raise typer.BadParameter(f"--worlds {worlds!r:.60}: give numbers from 1 on, separated by commas")
    dataset = open_dataset(out)
    done = dataset.scenes.to_table(columns=["scene_id"], filter=pc.field("status") == "done")["scene_id"].to_pylist()
    if not done:
        raise InputError(f"{out}: no finished scene to step")
    chosen = sample_evenly(done, scenes)
    agreement = list(measure_agreement(out, chosen, seconds, device, exported, jobs or count_available_cpus()))
    speeds = list(measure_speed([dataset.scene(name) for name in chosen] if counts else [], counts, device, exported))
    if as_json:
        agreeing = sum(its.agrees for its in agreement)
        print_json({"agreement": [*map(asdict, agreement)], "agreeing": agreeing, "speed": [*map(asdict, speeds)]})
    else:
        _show_agreement(agreement)
        _show_speeds(speeds)


def _show_agreement(agreement: "list[EngineAgreement]") -> None:
    rows = [
        (
            *(one.warp.scene_id, "overflow" if one.warp.overflowed else "rests" if one.warp.at_rest else "moves"),
            *(f"{1e3 * its.drift_m:.4f}" for its in (one.warp, one.mujoco)),
            *(its.contacts for its in (one.warp, one.mujoco)),
            *(f"{1e3 * its.penetration_m:.4f}" for its in (one.warp, one.mujoco)),
        )
        for one in agreement
    ]
    columns = ("scene", "Warp", "drift mm", "MuJoCo", "contacts", "MuJoCo", "depth mm", "MuJoCo")
    print_figures(columns, rows)
    print(f"both say the same about rest of {sum(its.agrees for its in agreement)} of {len(rows)} scenes")


def _show_speeds(speeds: "list[WarpSpeed]") -> None:
    rows = [
        (
            speed.worlds,
            speed.different,
            speed.device,
            f"{speed.steps_per_s:.0f}",
            speed.nconmax,
            speed.njmax,
            speed.overflowed,
        )
        for speed in speeds
    ]
    if rows:
        print_figures(("worlds", "scenes", "device", "steps/s", "nconmax", "njmax", "overflowed"), rows)
