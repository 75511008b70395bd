"""Arguments and options that several commands share."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from tableverse_factory.cli.completions import complete_config_keys, complete_scene_ids, complete_textures


def require_local_path(path: Path | None) -> Path | None:
    """Refuse a URI for local files: it would become a folder named `s3:`."""
    if path is not None and len(path.parts) > 1 and path.parts[0] in ("s3:", "gs:", "hf:", "http:", "https:", "file:"):
        raise typer.BadParameter(f"{path.parts[0]}//… is no folder of this machine: give one, and copy it there later")
    return path


Manifest = Annotated[
    str, typer.Argument(metavar="MANIFEST", help="Image manifest (Parquet), from `tableverse manifest`.")
]
BuiltOut = Annotated[
    str, typer.Argument(metavar="OUT", help="The dataset, finished or not: a folder, or s3://bucket/prefix.")
]
ReadableOut = Annotated[
    str, typer.Argument(metavar="OUT", help="The dataset, finished or not: a folder, s3://…, https://… or hf://….")
]
FinishedOut = Annotated[str, typer.Argument(metavar="OUT", help="A finished dataset: a folder, or s3://bucket/prefix.")]
SceneId = Annotated[
    str,
    typer.Argument(
        metavar="SCENE_ID", help="Which scene; `tableverse query OUT` lists them.", autocompletion=complete_scene_ids
    ),
]
NewFolder = Annotated[Path, typer.Argument(metavar="DEST", help="A new or empty folder.", callback=require_local_path)]
ConfigFile = Annotated[
    Path | None,
    typer.Option("--config", metavar="FILE", help="YAML with the keys that differ; `tableverse init` writes one."),
]
Overrides = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="A key of the configuration; may repeat.",
        autocompletion=complete_config_keys,
    ),
]
Epsilon = Annotated[float, typer.Option("--epsilon", min=0.0, help="Depth beyond which objects collide [m].")]
Jobs = Annotated[int | None, typer.Option(min=1, metavar="N", help="Processes; one per CPU by default.")]
AsJson = Annotated[bool, typer.Option("--json", help="One JSON document, for scripts.")]
Executor = Annotated[Literal["local", "ray"], typer.Option(help="One process, or Ray.")]
Workers = Annotated[
    int | None,
    typer.Option(
        min=1,
        metavar="N",
        help="CPUs that actors hold on Ray, and most actors of a pool that holds none; all by default.",
    ),
]
Address = Annotated[
    str | None, typer.Option(envvar="RAY_ADDRESS", metavar="HOST:PORT", help="A running Ray cluster, or auto.")
]
Pools = Annotated[
    Path | None, typer.Option(metavar="FILE", help="YAML: what the actors of each pool hold (docs/building.md).")
]
Limit = Annotated[int | None, typer.Option(min=1, metavar="N", help="Most scenes of this run.")]
Shards = Annotated[str | None, typer.Option(metavar="3-7,9", help="Work on these shards only.")]
MaxUsd = Annotated[
    float | None,
    typer.Option(min=0.0, metavar="USD", help="Most that the models may cost, over all runs of OUT (docs/models.md)."),
]
MaxCalls = Annotated[
    int | None, typer.Option(min=0, metavar="N", help="Most requests to models, over all runs of OUT.")
]
Metrics = Annotated[
    Path | None, typer.Option(metavar="FILE", help="Keep figures for Prometheus in this file (docs/monitoring.md).")
]
Robot = Annotated[
    str | None,
    typer.Option(metavar="ARM", help="The arm of trajectories whose robot is a file (*.xml) or menagerie:NAME."),
]
Texture = Annotated[
    str | None,
    typer.Option(
        metavar="NAME",
        help="What lies on the table: a seed, or family and number as marble-12.",
        autocompletion=complete_textures,
    ),
]
