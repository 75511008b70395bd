"""Audit of a scene: check its files and measure its certificate again."""

import os
from collections.abc import Collection, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import mujoco

from schemas.scene import Certificate
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.text import pluralize
from tableverse_factory.dataset.scene_meta import SceneMeta, read_meta
from tableverse_factory.dataset.trajectory_files import strip_motions
from tableverse_factory.physics.mjcf.load import load_model
from tableverse_factory.physics.mjcf.validate_model import check_time_step
from tableverse_factory.physics.simulate.certificate import Measurement, certify, measure_model
from tableverse_factory.stages.export.meta import compute_file_digests

MAX_SCENE_FILES = 20_000
MAX_SCENE_BYTES = 2 * 1024**3
# For the arithmetic of other machines; on the building machine the figures are equal.
LENGTH_TOLERANCE_M, ANGLE_TOLERANCE_RAD = 5e-5, 2e-3


@dataclass(frozen=True, slots=True)
class SceneAudit:
    """Audit of one scene."""

    scene_id: str
    measured: Mapping[str, Any]  # figures by the names of `Certificate`
    problems: tuple[str, ...]  # one line each

    @property
    def ok(self) -> bool:
        """Whether the audit found no problem."""
        return not self.problems


def audit_scene(scene_id: str, files: Mapping[str, bytes], row: Mapping[str, Any] | None = None) -> SceneAudit:
    """Measure a scene of ours again and compare it with its meta.json, and with its row of scenes/ if given."""
    try:
        meta = read_meta(files.get("meta.json", b"null"))
        model = load_model(files)
        check_time_step(model)
    except InputError as error:
        return SceneAudit(scene_id, {}, (str(error),))
    certificate, measured = certify(model, meta.history, meta.certificate.epsilon_m)
    values = _list_figures(certificate)
    problems = [
        *_check_files(files, meta),
        *_check_state(measured, certificate.epsilon_m),
        *_compare_figures("certificate", _list_figures(meta.certificate), values),
        *_compare_figures("scenes/", row or {}, values),
    ]
    if missing := sorted(set(meta.history.rectified) ^ set(measured.bodies)):
        problems.append(f"bodies and meta.json disagree on {', '.join(missing[:5])}")
    return SceneAudit(scene_id, values, tuple(problems))


def audit_model(name: str, model: mujoco.MjModel, epsilon_m: float) -> SceneAudit:
    """Measure any model: its free bodies against one another and against static ones."""
    try:
        check_time_step(model)
    except InputError as error:
        return SceneAudit(name, {}, (str(error),))
    measured = measure_model(model)
    figures = {
        "epsilon_m": epsilon_m,
        "bodies": len(measured.bodies),
        "piece_penetration_m": measured.pieces[0],
        "mesh_penetration_m": measured.meshes[0],
        "drift_m": measured.drift_m,
        "drift_rad": measured.drift_rad,
        "repaired": list(measured.repaired),
        "fell": list(measured.fell),
        "at_rest": measured.at_rest,
        "colliding": measured.colliding(epsilon_m),
    }
    return SceneAudit(name, figures, tuple(_check_state(measured, epsilon_m)))


def read_scene_folder(folder: Path, without: Collection[str] = ()) -> dict[str, bytes]:
    """Read the files of a scene folder by relative path, except those of `without`; links out of it are not followed.

    Raises:
        InputError: `too_many_files` or `file_too_large` if it exceeds the limits.
    """
    home, files, size = folder.resolve(), dict[str, bytes](), 0
    for root, folders, names in os.walk(folder):
        folders.sort()
        for path in (Path(root) / name for name in sorted(names)):
            name = path.relative_to(folder).as_posix()
            if name in without or not path.is_file() or not path.resolve().is_relative_to(home):
                continue
            size += path.stat().st_size
            if len(files) >= MAX_SCENE_FILES:
                raise InputError(f"{folder}: more than {MAX_SCENE_FILES} files: is this one scene?", "too_many_files")
            if size > MAX_SCENE_BYTES:
                raise InputError(f"{folder}: more than {MAX_SCENE_BYTES} bytes: is this one scene?", "file_too_large")
            files[name] = path.read_bytes()
    return files


def _check_files(files: Mapping[str, bytes], meta: SceneMeta) -> list[str]:
    exported = dict(strip_motions(tuple(files.items())))
    found = compute_file_digests({name: data for name, data in exported.items() if name != "meta.json"})
    names = sorted(set(found) | set(meta.files))
    changed = [name for name in names if found.get(name) != meta.files.get(name)]
    return [f"{pluralize(len(changed), 'file')} changed since the export: {', '.join(changed[:3])}"] if changed else []


def _check_state(measured: Measurement, epsilon_m: float) -> list[str]:
    problems = [] if measured.bodies else ["nothing to certify: no body has a free joint"]
    for kind, (depth, pair) in (("pieces", measured.pieces), ("meshes", measured.meshes)):
        if depth > epsilon_m:
            problems.append(f"{kind} {depth * 1e3:.2f} mm deep: {pair}")
    if measured.moved:
        problems.append(f"moved within 5 s: {', '.join(measured.moved[:5])}")
    if measured.fell:
        problems.append(f"fell: {', '.join(measured.fell[:5])}")
    if measured.warnings:
        problems.append(f"MuJoCo warned of {', '.join(measured.warnings)}")
    return problems


def _list_figures(certificate: Certificate) -> dict[str, Any]:
    return {f.name: getattr(certificate, f.name) for f in fields(Certificate)}


def _compare_figures(where: str, stored: Mapping[str, Any], measured: Mapping[str, Any]) -> list[str]:
    return [
        f"{key}: {where} says {stored[key]!r:.80}, measured {new!r:.80}"
        for key, new in measured.items()
        if key in stored and not _equal(key, stored[key], new)
    ]


def _equal(key: str, old: Any, new: Any) -> bool:
    if key == "displacement_m":
        a, b = dict(old), dict(new)
        return a.keys() == b.keys() and all(_equal("m", a[name], b[name]) for name in a)
    if isinstance(new, float):
        tolerance = ANGLE_TOLERANCE_RAD if key.endswith("_rad") else LENGTH_TOLERANCE_M
        return isinstance(old, float | int) and abs(old - new) <= tolerance
    return bool(old == new)
