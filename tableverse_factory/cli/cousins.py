"""`tableverse cousins`: new scenes from those of a finished dataset."""

from typing import Annotated

import typer

from tableverse_factory.cli import options
from tableverse_factory.cli.build import make_display, report_summary
from tableverse_factory.core.errors import InputError, TableverseError


def cousins(
    out: options.FinishedOut,
    dest: Annotated[
        str,
        typer.Argument(
            metavar="DEST", help="The dataset of cousins, a folder or s3://bucket/prefix; begun before, it goes on."
        ),
    ],
    per_scene: Annotated[
        int, typer.Option("--per-scene", min=1, max=1000, metavar="N", help="Cousins of a scene.")
    ] = 10,
    seed: Annotated[
        int | None, typer.Option("--seed", min=0, metavar="N", help="Another run.seed, other cousins.")
    ] = None,
    config: options.ConfigFile = None,
    overrides: options.Overrides = None,
    executor: options.Executor = "ray",
    workers: options.Workers = None,
    address: options.Address = None,
    pools: options.Pools = None,
    limit: options.Limit = None,
    shards: options.Shards = None,
    max_usd: options.MaxUsd = None,
    max_calls: options.MaxCalls = None,
    metrics: options.Metrics = None,
) -> None:
    """Make new scenes of finished ones: other things, elsewhere.

    Things are swapped for others of their kind, rescaled, turned, moved and removed, and whole scenes mirrored. Each
    cousin is separated, settled, judged and certified like any scene, or dropped with its reason; its row names its
    parent, its family and what was changed. DEST.parquet keeps the manifest. The same command again goes on. Exit codes
    are those of `build`.

    Example: `tableverse cousins out out-cousins --per-scene 10`
    """
    from tableverse_factory.core.config import load_config
    from tableverse_factory.core.storage.apart import require_apart
    from tableverse_factory.core.storage.files import parse_path
    from tableverse_factory.dataset.cousin_rows import list_cousins
    from tableverse_factory.dataset.dataset import open_dataset
    from tableverse_factory.dataset.image_rows import ImageRows
    from tableverse_factory.dataset.shard_plan import digest_manifest
    from tableverse_factory.sources.manifest import write_manifest
    from tableverse_factory.stages.curate.lexicon import find_kind
    from workers.api import build
    from workers.driver.signals import StopSignals
    from workers.plan.read_manifest import read_manifest

    source, place = parse_path(out), parse_path(dest)
    require_apart(place, source)
    manifest = place.parent / f"{place.name}.parquet"
    overrides = [*(overrides or []), *([] if seed is None else [f"run.seed={seed}"])]
    seed = load_config(config, overrides).run.seed  # what is refused leaves no manifest behind
    rows = ImageRows.from_rows(list_cousins(open_dataset(str(source.absolute())), per_scene, seed, find_kind))
    if written := not manifest.exists():
        write_manifest(manifest, rows)
    elif digest_manifest(read_manifest(manifest)) != digest_manifest(rows):
        raise InputError(
            f"{manifest} lists other rows than {per_scene} cousins of each scene with seed {seed}: give --per-scene "
            "and --seed as when it was written, or another DEST"
        )
    try:
        summary = build(
            str(manifest),
            dest,
            config=config,
            overrides=overrides,
            executor=executor,
            workers=workers,
            address=address,
            pools=pools,
            limit=limit,
            shards=shards,
            max_usd=max_usd,
            max_calls=max_calls,
            display=make_display(dest, metrics),
            signals=StopSignals(),
        )
    except TableverseError:
        if written and not (place / "plan.parquet").exists():
            manifest.unlink()  # a build that was refused leaves no manifest behind
        raise
    report_summary(summary, dest)
