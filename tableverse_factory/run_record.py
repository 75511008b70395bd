"""Record of a build (run.json): everything besides the input that decides the bytes of a dataset, and nothing else."""

import json
import platform
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from schemas.config import Config
from schemas.identity import content_hash
from tableverse_factory.core.config import fingerprint_config, fingerprint_tree, select_output_affecting
from tableverse_factory.core.errors import BuildError, StoreError
from tableverse_factory.core.source_hash import compute_source_hash
from tableverse_factory.core.storage.files import StoragePath, make_missing_build_error, read_whole, write_atomic
from tableverse_factory.core.text import describe_change
from tableverse_factory.stage import RecordFunction, Stage

FORMAT = "tableverse-dataset-1"
# Packages that decide bytes.
PACKAGES = (
    *("coacd", "coal", "embreex", "manifold3d", "mujoco", "mujoco-menagerie", "networkx", "numpy", "onnxruntime"),
    *("open3d-cpu", "pillow", "pyarrow", "pydantic", "scikit-image", "scipy", "tableverse-factory", "toppra"),
    "trimesh",
)
CODE = "versions.code"  # key of the hash of this package's code: a checkout may change it under the same version
AFTERWARDS = "afterwards"  # part with the versions that added trajectories to a dataset which others had made
_OF_MANIFEST = ("manifest.scenes", "manifest.sha256")
_MAX_SHOWN = 6


def make_run_record(
    config: Config, recorded: Mapping[str, Any], manifest_sha256: str, n_scenes: int, stages: Mapping[str, str]
) -> dict[str, Any]:
    """Make the record of a build: no clock, no host, no path but those that the configuration names.

    `recorded` is from `collect_external_inputs`; `stages` holds the fingerprint of what each reads besides its input.
    """
    return {
        "format": FORMAT,
        "seed": config.run.seed,
        "fingerprint": _combine_fingerprint(fingerprint_config(config), recorded),
        "stages": dict(stages),
        **recorded,
        "manifest": {"sha256": manifest_sha256, "scenes": n_scenes},
        "versions": collect_versions(),
        "config": select_output_affecting(config),
    }


def extend_run_record(
    base: Mapping[str, Any], config: Config, recorded: Mapping[str, Any], added: Mapping[str, str]
) -> dict[str, Any]:
    """Make the record of a finished dataset to which stages are added, keeping what made it.

    With the versions of the dataset it equals the record of the longer build from the start. `base` is the record as it
    is, `added` the fingerprints of the added stages.
    """
    sections = {section: config.model_dump(mode="json")[section] for section in added}
    parts = map_parts_to_stages()
    kept = {part: base[part] for part, stage in parts.items() if part in base and stage not in added}
    kept |= {part: value for part, value in recorded.items() if parts[part] in added}
    tree, versions = {**base["config"], **sections}, collect_versions()
    later = {AFTERWARDS: {"versions": versions}} if versions != base["versions"] else {}
    rest = {key: value for key, value in base.items() if key not in (*parts, AFTERWARDS)}
    return {
        **rest,
        "fingerprint": _combine_fingerprint(fingerprint_tree(tree), kept),
        "stages": {**base["stages"], **added},
        **kept,
        **later,
        "config": tree,
    }


def collect_package_versions() -> dict[str, str]:
    """Collect the versions of Python and of the packages that decide bytes."""
    return {"python": platform.python_version(), **{name: _version(name) for name in PACKAGES}}


def collect_versions() -> dict[str, str]:
    """Collect the versions of packages, and the hash of this package's code."""
    return {**collect_package_versions(), "code": compute_source_hash()}


def collect_external_inputs(
    config: Config, before: Mapping[str, Any] | None = None, base: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """Collect what decides bytes besides the manifest and the configuration, as the stages declare it.

    Reads every recorded answer, so once per build is enough.

    Args:
        config: Of the build.
        before: run.json of the build that is resumed; None for a new one. Weights of the hub stay at its commit.
        base: run.json of a finished dataset, whose inputs stay as they are but for those of post-export stages.
    """
    inputs = {
        part: record(config, before or {}) if base is None or stage.is_post_export else base.get(part)
        for part, (stage, record) in _list_recorders().items()
    }
    return {part: value for part, value in inputs.items() if value is not None}


def map_parts_to_stages() -> dict[str, str]:
    """Map each part of run.json that a stage records to the stage's name."""
    return {part: stage.name for part, (stage, _) in _list_recorders().items()}


def _list_recorders() -> dict[str, tuple[Stage, RecordFunction]]:
    from tableverse_factory.pipeline import WITH_TRAJECTORIES  # what stages check and record is not for readers

    stages = (stage for line in WITH_TRAJECTORIES.values() for stage in line)
    return {part: (stage, record) for stage in stages for part, record in stage.recorded.items()}


def _combine_fingerprint(own: str, recorded: Mapping[str, Any]) -> str:
    return content_hash(own.encode(), json.dumps(recorded, sort_keys=True).encode()) if recorded else own


def write_run(path: StoragePath, record: Mapping[str, Any]) -> None:
    """Write run.json durably."""
    write_atomic(path, (json.dumps(record, indent=2, sort_keys=True) + "\n").encode())


def read_run(path: StoragePath) -> dict[str, Any]:
    """Read run.json; BuildError if there is none, or it is not the record of a build."""
    try:
        record = json.loads(read_whole(path))
    except FileNotFoundError:
        raise make_missing_build_error(path) from None
    except NotADirectoryError:
        raise BuildError(f"{path.parent} is a file: give the OUT of `tableverse build`, a folder") from None
    except StoreError:
        raise
    except (OSError, ValueError) as error:
        raise BuildError(f"{path} cannot be read: {error}. Put it back from a copy, or give another OUT") from error
    if not isinstance(record, dict) or record.get("format") != FORMAT:
        raise BuildError(f"{path} is no record of a build of format {FORMAT}")
    return record


def diff_run_records(before: Mapping[str, Any], now: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    """Find what differs between two records, by dotted key: the value before and the one now."""
    old, new = _flatten(before), _flatten(now)
    derived = ("fingerprint", "stages.")
    keys = sorted(key for key in {*old, *new} if old.get(key) != new.get(key) and not key.startswith(derived))
    if "config.run.seed" in keys and "seed" in keys:
        keys.remove("seed")  # it repeats the key of the configuration
    return {key: (old.get(key), new.get(key)) for key in keys}


def resume_refused_error(
    out: str, differing: Mapping[str, tuple[Any, Any]], section: str, option: str = "", manifest: str = ""
) -> BuildError:
    """Make the error of a build that would not give the bytes of the one that was begun in `out`.

    `section` is the stage from which everything could be recomputed, if any, with `option` or `--from`. `manifest` says
    how the manifest differs, if it does.
    """
    code = (
        f". {CODE} is tableverse-factory's own code, which a `git pull` changes too: --from computes the stage that it "
        "names and what follows with the code that is here now, and keeps what came before"
    )
    changes = [_describe_change(*item) for item in differing.items() if not (manifest and item[0] in _OF_MANIFEST)]
    changes = [manifest, *changes] if manifest else changes
    shown = ", ".join(changes[:_MAX_SHOWN])
    more = f" and {len(changes) - _MAX_SHOWN} more" if len(changes) > _MAX_SHOWN else ""
    again = f"add {option or f'--from {section}'} to compute that stage again and what follows it, " if section else ""
    begun = "the manifest that it was begun with" if manifest else "what it was begun with (see run.json)"
    return BuildError(
        f"{out} was begun as another build: {shown}{more}. Go on with {begun}, {again}or give another OUT"
        f"{code if section and CODE in differing else ''}"
    )


def _describe_change(key: str, values: tuple[Any, Any]) -> str:
    """Describe a change by its values, but for hashes, which say nothing."""
    old, new = values
    if key.endswith("sha256") and None not in values:
        return f"the content of {key.removesuffix('sha256').rstrip('._')} differs"
    return describe_change(key, old, new)


def _flatten(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    leaves: dict[str, Any] = {}
    for key, value in tree.items():
        if isinstance(value, Mapping):
            leaves |= _flatten(value, f"{prefix}{key}.")
        else:
            leaves[prefix + key] = value
    return leaves


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "absent"
