"""`tableverse evaluate`: any method's scenes against one another, against a judge, against the truth."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from tableverse_factory.evaluate.collisions import MethodCollisions, SceneCollisions

evaluate = typer.Typer(name="evaluate", help="Compare the scenes of any methods.", no_args_is_help=True)

Methods = Annotated[
    list[str] | None, typer.Option("--method", help="NAME=PATH; as often as there are methods.", metavar="NAME=PATH")
]
AsJson = Annotated[bool, typer.Option("--json", help="One JSON document instead of a table.")]


@evaluate.command("collisions")
def evaluate_collisions(
    paths: Annotated[
        list[Path] | None,
        typer.Argument(help="Datasets, layouts, GLB or MJCF scenes, or folders of them; named after their folder."),
    ] = None,
    method: Methods = None,
    epsilon_m: Annotated[
        float, typer.Option("--epsilon", min=0.0, help="Depth that is no collision yet [m].")
    ] = 0.0001,
    meshes_only: Annotated[
        bool, typer.Option("--meshes-only", help="Leave out the convex pieces, which take time to make.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Count the scenes in which any two objects lie inside one another, on meshes and on convex pieces.

    Exit code 1 if a scene could not be measured; it is named, and does not count.

    Example: `tableverse evaluate collisions --method ours=out --method midi=midi/ --epsilon 0.001`
    """
    import json

    from tableverse_factory.cli.cache import cache_folder
    from tableverse_factory.evaluate.collisions import measure_method
    from tableverse_factory.evaluate.methods import named_methods
    from tableverse_factory.evaluate.sources import find_scenes

    cache = None if meshes_only else cache_folder()
    methods = named_methods(paths or [], method or [])
    sources = {name: find_scenes(path) for name, path in methods.items()}
    measured = [measure_method(name, its, epsilon_m, cache) for name, its in sources.items()]
    if as_json:
        print(json.dumps({"epsilon_m": epsilon_m, "methods": [_as_json(each) for each in measured]}, indent=1))
    else:
        _show_collisions(measured, epsilon_m)
    if any(scene.error for each in measured for scene in each.scenes):
        raise typer.Exit(1)


def _as_json(method: "MethodCollisions") -> dict[str, Any]:
    return {
        "method": method.method,
        "scenes": len(method.scenes),
        "measured": len(method.measured),
        "collision_rate": method.rate(),
        "collision_rate_95": method.interval(),
        "piece_collision_rate": method.piece_rate(),
        "per_scene": [_scene_as_json(scene, method.epsilon_m) for scene in method.scenes],
    }


def _scene_as_json(scene: "SceneCollisions", epsilon_m: float) -> dict[str, Any]:
    if scene.error:
        return {"scene": scene.name, "error": scene.error}
    pairs = {"meshes": scene.meshes, "pieces": scene.pieces}
    return {
        "scene": scene.name,
        "objects": scene.objects,
        "colliding": scene.depth_m > epsilon_m,
        "depth_m": scene.depth_m,
        "piece_depth_m": scene.piece_depth_m,
        **{
            key: None if its is None else [{"a": a, "b": b, "depth_m": depth} for a, b, depth in its]
            for key, its in pairs.items()
        },
    }


def _show_collisions(methods: "list[MethodCollisions]", epsilon_m: float) -> None:
    import numpy as np
    from rich.console import Console
    from rich.table import Table

    from tableverse_factory.text import printable

    title = f"scenes in which two objects overlap by more than {1e3 * epsilon_m:g} mm"
    table = Table("method", box=None, pad_edge=False, title=title, title_justify="left")
    for name in ("scenes", "colliding %", "95 %", "on pieces %", "median mm", "deepest mm"):
        table.add_column(name, justify="right")
    for each in methods:
        depths = [1e3 * scene.depth_m for scene in each.measured] or [float("nan")]
        low, high = each.interval() or (float("nan"), float("nan"))
        interval = f"{100 * low:.0f}–{100 * high:.0f}"
        rates = _percent(each.rate()), interval, _percent(each.piece_rate())
        spread = f"{np.median(depths):.2f}", f"{max(depths):.2f}"
        table.add_row(printable(each.method, 40), str(len(each.measured)), *rates, *spread)
    Console(markup=False).print(table)
    for each in methods:
        for scene in (scene for scene in each.scenes if scene.error):
            print(f"not measured: {printable(each.method, 40)}: {printable(scene.name, 80)}: {printable(scene.error)}")


def _percent(share: float | None) -> str:
    return "–" if share is None else f"{100 * share:.1f}"
