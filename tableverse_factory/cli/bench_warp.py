"""`tableverse bench warp`: MuJoCo Warp on scenes of a dataset."""

from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

from tableverse_factory.cli.options import AsJson, ReadableOut
from tableverse_factory.cli.tables import print_figures, print_json

if TYPE_CHECKING:
    from tableverse_factory.evaluation.bench.warp import WarpAgreement, WarpSpeed


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
    as_json: AsJson = False,
) -> None:
    """Measure steps per second of MuJoCo Warp, and how far it agrees with MuJoCo: rest, drift and contacts.

    Different scenes are stepped in one batch, padded to the largest. Needs mujoco-warp; the first run compiles kernels
    for a minute or two.

    Example: `tableverse bench warp out --worlds 1,4 --scenes 4 --seconds 1 --device cpu`
    """
    import pyarrow.compute as pc

    from tableverse_factory.core.errors import InputError
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
    chosen = [dataset.scene(scene_id) for scene_id in sample_evenly(done, scenes)]
    agreement = measure_agreement(chosen, seconds, device, exported)
    speeds = list(measure_speed(chosen, counts, device, exported))
    if as_json:
        print_json({"agreement": asdict(agreement), "agreeing": agreement.agreeing, "speed": [*map(asdict, speeds)]})
    else:
        _show_agreement(agreement)
        _show_speeds(speeds)


def _show_agreement(agreement: "WarpAgreement") -> None:
    theirs = zip(
        agreement.warp, agreement.mujoco_drift_m, agreement.mujoco_contacts, agreement.mujoco_penetration_m, strict=True
    )
    rows = [
        (
            *(one.scene_id, "overflow" if one.overflowed else "rests" if one.at_rest else "moves"),
            *(f"{1e3 * length:.4f}" for length in (one.drift_m, drift_m)),
            *(one.contacts, contacts),
            *(f"{1e3 * length:.4f}" for length in (one.penetration_m, depth_m)),
        )
        for one, drift_m, contacts, depth_m in theirs
    ]
    columns = ("scene", "Warp", "drift mm", "MuJoCo", "contacts", "MuJoCo", "depth mm", "MuJoCo")
    print_figures(columns, rows)
    print(f"both say the same about rest of {agreement.agreeing} of {len(rows)} scenes")


def _show_speeds(speeds: "list[WarpSpeed]") -> None:
    rows = [
        (speed.worlds, speed.different, speed.device, f"{speed.steps_per_s:.0f}", speed.nconmax, speed.njmax)
        for speed in speeds
    ]
    if rows:
        print_figures(("worlds", "scenes", "device", "steps/s", "nconmax", "njmax"), rows)
