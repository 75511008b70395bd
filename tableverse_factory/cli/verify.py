"""`tableverse verify`: measure certificates again, and replay trajectories."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from tableverse_factory.cli.arm import check_robot_option
from tableverse_factory.cli.options import AsJson, Jobs, Robot
from tableverse_factory.cli.tables import print_json
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.text import pluralize, sanitize_line

if TYPE_CHECKING:
    from tableverse_factory.evaluation.scene_audit import SceneAudit


def verify(
    path: Annotated[
        str,
        typer.Argument(
            metavar="PATH", help="OUT of a build, any MJCF file, a folder that `extract` wrote, or a folder of those."
        ),
    ],
    epsilon_m: Annotated[
        float | None,
        typer.Option(
            "--epsilon",
            min=0.0,
            metavar="M",
            help="For MJCF files: depth beyond which objects collide [m]; 0.001 by default. A dataset states its own.",
        ),
    ] = None,
    root: Annotated[
        Path | None,
        typer.Option(
            help="For MJCF files: folder that contains all files they name, if not PATH.", exists=True, file_okay=False
        ),
    ] = None,
    trajectories: Annotated[
        bool, typer.Option("--trajectories", help="Of a dataset: also replay every trajectory from its arrays.")
    ] = False,
    robot: Robot = None,
    engine: Annotated[
        Literal["mujoco", "warp", "newton"],
        typer.Option(help="Of a dataset: measure rest and contacts in MuJoCo Warp or Newton instead."),
    ] = "mujoco",
    jobs: Jobs = None,
    as_json: AsJson = False,
) -> None:
    """Measure every certificate again; replay trajectories.

    Files, penetrations, drift and falls are compared with the certificate. With --trajectories each trajectory is
    executed again in physics from its saved arrays: successes must succeed, all must move as recorded, and rows must
    match tasks and configuration.

    With --engine warp or newton scenes are stepped there, on a GPU where there is one; files and meshes are not
    measured then.

    Exit code 0 only if every scene is whole, at rest, free of collisions and as certified, and every trajectory as
    recorded.

    Example: `tableverse verify out`, `tableverse verify out --trajectories`, `tableverse verify their/scene.xml --json`
    """
    from tableverse_factory.core.process_pool import count_available_cpus

    if robot is not None and not trajectories:
        raise typer.BadParameter("--robot is the arm of trajectories: give --trajectories too")
    if epsilon_m is not None and _is_dataset(path):
        raise typer.BadParameter("--epsilon is for MJCF files: the certificates of a dataset state theirs")
    if root is not None and _is_dataset(path):
        raise typer.BadParameter("--root is for MJCF files: the scenes of a dataset are whole")
    if engine != "mujoco" and (trajectories or not _is_dataset(path)):
        raise typer.BadParameter("--engine is for the scenes of a dataset, without --trajectories")
    if trajectories and _is_dataset(path):
        check_robot_option(path, robot, needed=True)
    audits = []
    depth_m, processes = 0.001 if epsilon_m is None else epsilon_m, jobs or count_available_cpus()
    if engine == "mujoco":
        run = _run_audits(path, depth_m, root, processes, trajectories, robot)
    else:
        run = _run_in_engine(path, engine)
    for audit in run:
        audits.append(audit)
        if not as_json:
            _print_audit(audit, first=len(audits) == 1)
    good, rest = sum(audit.ok for audit in audits), _count_not_built(path) if _is_dataset(path) else 0
    if as_json:
        scenes = [{"scene_id": a.scene_id, "ok": a.ok, "problems": a.problems, **a.measured} for a in audits]
        print_json({"ok": good == len(audits), "verified": good, "not_built": rest, "scenes": scenes}, indent=1)
    else:
        later = f"; {pluralize(rest, 'scene')} not built yet" if rest else ""
        print(f"{good} of {pluralize(len(audits), 'scene')} verified{later}")
    if good < len(audits):
        raise typer.Exit(1)


def _is_dataset(path: str) -> bool:
    folder = Path(path)
    return "://" in path or (folder / "run.json").is_file() or any(folder.glob("scenes/shard-*.parquet"))


def _count_not_built(path: str) -> int:
    """Count the scenes that a dataset's build has still to account for; 0 if others selected the scenes."""
    from tableverse_factory.dataset.dataset import open_dataset

    dataset = open_dataset(path)
    run = dataset.record() or {}
    manifest = {} if "published" in run else run.get("manifest")
    planned = manifest.get("scenes") if isinstance(manifest, dict) else None
    return max(0, planned - dataset.scenes.count_rows()) if isinstance(planned, int) else 0


def _run_in_engine(path: str, engine: str) -> Iterator["SceneAudit"]:
    from tableverse_factory.delivery.learning.warp import silence_warp
    from tableverse_factory.evaluation.verify_engine import verify_in_engine

    silence_warp(engine)
    return verify_in_engine(path, engine)


def _run_audits(
    path: str, epsilon_m: float, root: Path | None, jobs: int, trajectories: bool, robot: str | None
) -> Iterator["SceneAudit"]:
    from tableverse_factory.delivery.formats.folders import find_mjcf, list_scene_folders
    from tableverse_factory.evaluation.verify import verify_scenes

    folder = Path(path)
    if trajectories and not _is_dataset(path):
        raise InputError(f"{path}: --trajectories needs a dataset; give OUT of a build")
    if path.endswith(".xml") and folder.is_file():
        yield _audit_file(folder, epsilon_m, root or folder.parent)
    elif find_mjcf(folder) is not None:
        yield _audit_folder(folder, epsilon_m, root or folder)
    elif _is_dataset(path):
        yield from verify_scenes(path, jobs, trajectories, robot)
    elif folder.is_dir() and list_scene_folders(folder):
        for name, _ in list_scene_folders(folder):
            yield _audit_folder(folder / name, epsilon_m, root or folder)
    else:
        found = "nothing there can be verified" if folder.exists() else "no such file or folder"
        raise InputError(
            f"{path}: {found}; give OUT of `tableverse build`, an MJCF file (*.xml), a scene's folder (scene.xml, or "
            "an XML beside assets/), or a folder of such; layouts and GLB are measured by `tableverse evaluate`"
        )


def _audit_file(path: Path, epsilon_m: float, root: Path) -> "SceneAudit":
    from tableverse_factory.evaluation.scene_audit import audit_model
    from tableverse_factory.physics.mjcf.file_check import load_mjcf

    return audit_model(path.name, load_mjcf(path, root), epsilon_m)


def _audit_folder(folder: Path, epsilon_m: float, root: Path) -> "SceneAudit":
    from tableverse_factory.delivery.formats.folders import SCENE_GLB, find_mjcf
    from tableverse_factory.evaluation.scene_audit import SceneAudit, audit_scene, read_scene_folder

    document = find_mjcf(folder)
    try:
        if (folder / "meta.json").is_file():
            return audit_scene(folder.name, read_scene_folder(folder, {SCENE_GLB}))
        if document is None:
            raise InputError(f"{folder}: no MJCF in it", "no_mjcf")
        return replace(_audit_file(document, epsilon_m, root), scene_id=folder.name)
    except InputError as error:
        return SceneAudit(folder.name, {}, (str(error),))


def _print_audit(audit: "SceneAudit", first: bool) -> None:
    if first:
        print(f"{'scene':40} {'verdict':8} {'pieces':>8} {'meshes':>8} {'drift':>8} {'turn':>8}")
        print(f"{'':40} {'':8} {'[mm]':>8} {'[mm]':>8} {'[mm]':>8} {'[deg]':>8}")
    m = audit.measured
    verdict = "ok" if audit.ok else "BAD"
    cells = ""
    if "drift_m" in m:
        lengths = (m["piece_penetration_m"], m.get("mesh_penetration_m"), m["drift_m"])
        cells = "".join(f" {'–':>8}" if value is None else f" {1e3 * value:8.3f}" for value in lengths)
        cells += f" {57.29578 * m['drift_rad']:8.3f}"
    print(f"{sanitize_line(audit.scene_id, 40):40} {verdict:8}{cells}")
    if replayed := m.get("trajectories", ()):
        print(f"    {sum(it['reproduced'] for it in replayed)} of {len(replayed)} trajectories reproduced")
    for problem in audit.problems:
        print(f"    {sanitize_line(problem, 500)}")
