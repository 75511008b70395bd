"""`tableverse verify`: the certificates, measured again; the trajectories, executed again."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tableverse_factory.cli.arm import check_arm
from tableverse_factory.cli.options import AsJson

if TYPE_CHECKING:
    from schemas.config import TrajectoriesConfig
    from tableverse_factory.export.audit import Audit
    from tableverse_factory.robots.arm import Arm


def verify(
    path: Annotated[
        str,
        typer.Argument(
            metavar="PATH", help="OUT of a build, any MJCF file, a folder that `extract` wrote, or a folder of such."
        ),
    ],
    epsilon_m: Annotated[
        float,
        typer.Option("--epsilon", min=0.0, metavar="M", help="For an MJCF file: depth that is no collision yet [m]."),
    ] = 0.001,
    root: Annotated[
        Path | None,
        typer.Option(
            help="For MJCF files: the folder that all they name must lie in, if not PATH.", exists=True, file_okay=False
        ),
    ] = None,
    trajectories: Annotated[
        bool, typer.Option("--trajectories", help="Of a dataset: replay every trajectory from its arrays too.")
    ] = False,
    robot: Annotated[
        str | None,
        typer.Option(metavar="ARM", help="With --trajectories: the arm of those whose robot came from a file (*.xml)."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Measure every certificate again; replay trajectories.

    Penetrations, drift and falls are compared with the certificate, byte and figure. With --trajectories each motion
    is executed again in physics, from its saved arrays alone: what its row calls a success has to succeed, all has to
    move as it was recorded, and rows have to fit tasks and configuration.

    Exit code 0 only if every scene is whole, at rest, free of collisions and as certified, and every trajectory as
    recorded.

    Example: `tableverse verify out`, `tableverse verify out --trajectories`, `tableverse verify their/scene.xml --json`
    """
    if robot is not None and not trajectories:
        raise typer.BadParameter("--robot is the arm of trajectories: give --trajectories too")
    if trajectories and _is_dataset(path):
        check_arm(path, robot, needed=True)
    audits = []
    for audit in _audits(path, epsilon_m, root, _replays(path, robot) if trajectories else None):
        audits.append(audit)
        if not as_json:
            _print_line(audit, first=len(audits) == 1)
    good = sum(audit.ok for audit in audits)
    if as_json:
        scenes = [{"scene_id": a.scene_id, "ok": a.ok, "problems": a.problems, **a.measured} for a in audits]
        print(json.dumps({"ok": good == len(audits), "verified": good, "scenes": scenes}, indent=1))
    else:
        print(f"{good} of {len(audits)} scenes verified")
    if good < len(audits):
        raise typer.Exit(1)


@dataclass(frozen=True, slots=True)
class _Replays:
    """That trajectories are replayed.

    Attributes:
        arm: Of those whose robot came from a file.
        config: What they were made with, by run.json.
        tasks: Rows of tasks/ by scene.
    """

    arm: "Arm | None"
    config: "TrajectoriesConfig"
    tasks: Mapping[str, Sequence[Mapping[str, Any]]]

    def added_to(self, audit: "Audit", files: Mapping[str, bytes], rows: Sequence[Mapping[str, Any]]) -> "Audit":
        """The audit of a scene with that of its trajectories."""
        from tableverse_factory.motion_files import misfits
        from tableverse_factory.proof.audit import audit_trajectories

        tasks = self.tasks.get(audit.scene_id, ())
        known = set(audit.problems)
        unfit = misfits(rows, files, [task["task_id"] for task in tasks if task["accepted"]])
        audit = replace(audit, problems=(*audit.problems, *(line for line in unfit if line not in known)))
        replays = audit_trajectories(files, rows, self.arm, tasks, self.config)
        problems = [f"{replay.task_id}: {problem}" for replay in replays for problem in replay.problems]
        measured = {**audit.measured, "trajectories": [asdict(replay) for replay in replays]}
        return replace(audit, measured=measured, problems=(*audit.problems, *problems))


def _replays(path: str, robot: str | None) -> _Replays:
    """What replays of a dataset need to know.

    Raises:
        InputError: if there is no dataset at `path`, or its run.json does not say what it was made with.
        ConfigError: if this version knows other keys, or no such robot.
    """
    from tableverse_factory.dataset import open_dataset
    from tableverse_factory.errors import InputError
    from tableverse_factory.reading import MAX_JSON_BYTES, parse_json, read_bytes
    from tableverse_factory.restored import restored_config
    from tableverse_factory.robots.doors import arm_of

    if not _is_dataset(path):
        raise InputError(f"{path}: trajectories are replayed from a dataset, where their rows are; give OUT of a build")
    tasks: dict[str, list[Mapping[str, Any]]] = {}
    for task in open_dataset(path).tasks.to_table().to_pylist():
        tasks.setdefault(str(task["scene_id"]), []).append(task)
    run = parse_json(read_bytes(f"{path.rstrip('/')}/run.json", MAX_JSON_BYTES, "bad_run"), "run.json", "bad_run")
    if not isinstance(run, dict):
        raise InputError(f"{path}: run.json is no record of a build", "bad_run")
    return _Replays(arm_of(robot) if robot else None, restored_config(run, "trajectories").trajectories, tasks)


def _is_dataset(path: str) -> bool:
    folder = Path(path)
    return "://" in path or (folder / "run.json").is_file() or any(folder.glob("scenes/shard-*.parquet"))


def _audits(path: str, epsilon_m: float, root: Path | None, replays: _Replays | None) -> Iterator["Audit"]:
    from tableverse_factory.errors import InputError
    from tableverse_factory.formats.folders import mjcf_file, scene_folders

    folder = Path(path)
    if path.endswith(".xml") and folder.is_file():
        yield _audit_file(folder, epsilon_m, root or folder.parent)
    elif mjcf_file(folder) is not None:
        yield _audit_folder(folder, epsilon_m, root or folder)
    elif _is_dataset(path):
        yield from _audit_dataset(path, replays)
    elif folder.is_dir() and scene_folders(folder):
        for name, _ in scene_folders(folder):
            yield _audit_folder(folder / name, epsilon_m, root or folder)
    else:
        found = "nothing there can be verified" if folder.exists() else "no such file or folder"
        raise InputError(
            f"{path}: {found}; give OUT of `tableverse build`, an MJCF file (*.xml), a scene's folder (scene.xml, or "
            "an XML beside assets/), or a folder of such; layouts and GLB are measured by `tableverse evaluate`"
        )


def _audit_file(path: Path, epsilon_m: float, root: Path) -> "Audit":
    from tableverse_factory.export.audit import audit_model
    from tableverse_factory.physics.mjcf_files import load_mjcf

    return audit_model(path.name, load_mjcf(path, root), epsilon_m)


def _audit_folder(folder: Path, epsilon_m: float, root: Path) -> "Audit":
    from tableverse_factory.errors import InputError
    from tableverse_factory.export.audit import Audit, audit_scene, read_scene_folder
    from tableverse_factory.formats.folders import SCENE_GLB, mjcf_file

    document = mjcf_file(folder)
    try:
        if (folder / "meta.json").is_file():
            return audit_scene(folder.name, read_scene_folder(folder, {SCENE_GLB}))
        if document is None:
            raise InputError(f"{folder}: no MJCF in it", "no_mjcf")
        return replace(_audit_file(document, epsilon_m, root), scene_id=folder.name)
    except InputError as error:
        return Audit(folder.name, {}, (str(error),))


def _audit_dataset(path: str, replays: _Replays | None) -> Iterator["Audit"]:
    import pyarrow.compute as pc

    from schemas.arrow import TABLES
    from tableverse_factory.dataset import open_dataset
    from tableverse_factory.errors import InputError
    from tableverse_factory.export.audit import Audit, audit_scene
    from tableverse_factory.motion_files import changed

    dataset = open_dataset(path)
    for table in TABLES:  # a shard that has lost one is not whole, even where each of its scenes is
        try:
            dataset.table(table)
        except InputError as error:
            raise InputError(
                f"{error}: delete the file of that name in scenes/, and the same build makes the shard again"
            ) from None
    done = dataset.scenes.to_table(filter=pc.field("status") == "done", columns=["scene_id"])
    if not done.num_rows:
        raise InputError(f"{path}: no scene is done, so there is nothing to verify; see `tableverse failures {path}`")
    if replays is not None and not dataset.trajectories.count_rows():
        raise InputError(f"{path}: no trajectories in it to replay; `tableverse trajectories {path}` adds them")
    for scene_id in done.column(0).to_pylist():
        try:
            scene = dataset.scene(scene_id)
        except InputError as error:
            yield Audit(scene_id, {}, (str(error),))
            continue
        files, rows = scene.files(), scene.trajectory_rows()
        audit = audit_scene(scene_id, files, scene.row)
        audit = replace(audit, problems=(*audit.problems, *changed(rows, files, scene.row)))
        yield audit if replays is None else replays.added_to(audit, files, rows)


def _print_line(audit: "Audit", first: bool) -> None:
    from tableverse_factory.text import printable

    if first:
        print(f"{'scene':40} {'verdict':8} {'pieces':>8} {'meshes':>8} {'drift':>8} {'turn':>8}")
        print(f"{'':40} {'':8} {'[mm]':>8} {'[mm]':>8} {'[mm]':>8} {'[deg]':>8}")
    m = audit.measured
    verdict = "ok" if audit.ok else "BAD"
    print(f"{printable(audit.scene_id, 40):40} {verdict:8}" + (_cells(m) if "drift_m" in m else ""))
    if replayed := m.get("trajectories", ()):
        print(f"    {sum(it['reproduced'] for it in replayed)} of {len(replayed)} trajectories reproduced")
    for problem in audit.problems:
        print(f"    {printable(problem, 500)}")


def _cells(measured: Mapping[str, Any]) -> str:
    lengths = (measured["piece_penetration_m"], measured["mesh_penetration_m"], measured["drift_m"])
    return "".join(f" {1e3 * value:8.3f}" for value in lengths) + f" {57.29578 * measured['drift_rad']:8.3f}"
