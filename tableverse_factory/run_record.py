"""run.json: everything besides the input that decides the bytes of a dataset, and nothing that does not."""

import json
import platform
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from schemas.config import Config
from schemas.identity import content_hash
from tableverse_factory.core.config import fingerprint, fingerprint_of, output_affecting_config
from tableverse_factory.core.errors import BuildError, ConfigError, InputError, StoreError
from tableverse_factory.core.source_hash import source_hash
from tableverse_factory.core.storage.files import StoragePath, missing_build_error, read_whole, write_atomic
from tableverse_factory.models.local.fingerprint import DISTRIBUTED_BY, identity, onnx_identity
from tableverse_factory.models.local.hf_weights import PUBLISHED, at_commit, on_hub
from tableverse_factory.stages.curate.prompt import PROMPT_SHA256
from tableverse_factory.stages.perceive.vlm.prompt import box_order, prompt_sha256

FORMAT = "tableverse-dataset-1"
PACKAGES = (
    "coacd",
    "coal",
    "embreex",
    "manifold3d",
    "mujoco",
    "mujoco-menagerie",
    "networkx",
    "numpy",
    "open3d-cpu",
    "pillow",
    "pyarrow",
    "pydantic",
    "scikit-image",
    "scipy",
    "tableverse-factory",
    "toppra",
    "trimesh",
)
"""Packages that decide bytes."""

RECORDED_BY = {
    "answers": "curate",
    "depth": "observe",
    "detector": "perceive",
    "prompts": "curate",
    "robot": "trajectories",
    "segmenter": "perceive",
}
"""The stage that reads what a part of run.json describes, besides its input and the configuration."""

WEIGHTS = {"depth": ("observe", "depth_weights"), "segmenter": ("perceive", "segmenter_weights")}
"""Section and key of the configuration that name weights of the hub, by the part of run.json that says which commit."""

CODE = "versions.code"
"""Key of run.json: a hash of our own code, which a checkout may have changed under the same version."""

AFTERWARDS = "afterwards"
"""Part of run.json where trajectories were added to a dataset that other versions had made: the versions of those."""

_MAX_SHOWN = 6


def run_record(
    config: Config, recorded: Mapping[str, Any], manifest_sha256: str, n_scenes: int, stages: Mapping[str, str]
) -> dict[str, Any]:
    """What run.json says of a build: no clock, no host, no path but those that the configuration names.

    Args:
        config: Of the build.
        recorded: From `external_inputs`.
        manifest_sha256: Of the manifest's rows.
        n_scenes: How many there are.
        stages: Fingerprint of each stage: what it reads besides its input.
    """
    return {
        "format": FORMAT,
        "seed": config.run.seed,
        "fingerprint": _fingerprint(config, recorded),
        "stages": dict(stages),
        **recorded,
        "manifest": {"sha256": manifest_sha256, "scenes": n_scenes},
        "versions": own_versions(),
        "config": output_affecting_config(config),
    }


def extend_run_record(
    base: Mapping[str, Any], config: Config, recorded: Mapping[str, Any], added: Mapping[str, str]
) -> dict[str, Any]:
    """What run.json says of a finished dataset to which stages are added: what made it stays as it was.

    With the versions of the dataset it is the record of the longer build from the start.

    Args:
        base: Of the dataset as it is.
        config: Of the added stages.
        recorded: What the added stages read besides.
        added: Their fingerprints.
    """
    sections = {section: config.model_dump(mode="json")[section] for section in added}
    own = {name for name, stage in RECORDED_BY.items() if stage in added}
    kept = {name: base[name] for name in RECORDED_BY if name in base and name not in own}
    kept |= {name: value for name, value in recorded.items() if name in own}
    tree, versions = {**base["config"], **sections}, own_versions()
    later = {AFTERWARDS: {"versions": versions}} if versions != base["versions"] else {}
    rest = {key: value for key, value in base.items() if key not in (*RECORDED_BY, AFTERWARDS)}
    return {
        **rest,
        "fingerprint": _with_recorded(fingerprint_of(tree), kept),
        "stages": {**base["stages"], **added},
        **kept,
        **later,
        "config": tree,
    }


def package_versions() -> dict[str, str]:
    """The versions here of Python and of the packages that decide bytes."""
    return {"python": platform.python_version(), **{name: _version(name) for name in PACKAGES}}


def own_versions() -> dict[str, str]:
    """What decides bytes here: versions of packages, and the hash of our own code."""
    return {**package_versions(), "code": source_hash()}


def external_inputs(config: Config, before: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """What decides bytes besides the manifest and the values of the configuration: answers, prompts, weights, robot.

    All answers are read for it: once per build is enough.

    Args:
        config: Of the build.
        before: run.json of the build that goes on; None for a new one. Weights of the hub stay at its commit.

    Raises:
        ConfigError: if the folder of recorded answers is not there, or weights on the disk, or the file of the robot.
        ModelAccessError: if nobody can say which commit is meant by weights of the hub.
    """
    inputs: dict[str, Any] = {}
    if config.curate.judge == "replay":
        inputs["answers"] = _answers(Path(config.curate.replay_dir))
    if config.curate.asked:
        inputs["prompts"] = {"judge": PROMPT_SHA256}
    if config.perceive.asked:
        inputs["detector"] = {"prompt_sha256": prompt_sha256(box_order(config.perceive))}
    if config.perceive.detector == "learned":
        weights = config.perceive.detector_weights
        inputs["detector"] = _there("perceive.detector_weights", weights, onnx_identity(weights), "give the .onnx file")
    if config.observe.depth not in ("sensor", "recorded"):
        inputs["depth"] = _model("depth", config.observe.depth, config, before or {})
    if config.perceive.segmenter != "geometric":
        inputs["segmenter"] = _model("segmenter", config.perceive.segmenter, config, before or {})
    return {**inputs, **robot_input(config)}


def with_commits(config: Config, recorded: Mapping[str, Any]) -> Config:
    """The configuration as its stages get it: weights of the hub at the commit that `external_inputs` tells."""
    for part, (section, key) in WEIGHTS.items():
        if weights := recorded.get(part, {}).get("weights"):
            own = getattr(config, section).model_copy(update={key: weights})
            config = config.model_copy(update={section: own})
    return config


def _model(part: str, backend: str, config: Config, before: Mapping[str, Any]) -> dict[str, Any]:
    """What a model with weights is: those of the disk by their bytes, those of the hub by their commit.

    What is written as it was when the build began stays at its commit, wherever a branch has gone since.

    Raises:
        ConfigError, ModelAccessError: as `external_inputs`.
    """
    section, name = WEIGHTS[part]
    written = getattr(getattr(config, section), name)
    key, weights = f"{section}.{name}", written or PUBLISHED[backend]
    hub, found = on_hub(weights, key), identity(weights, config.models, DISTRIBUTED_BY.get(backend))
    if hub is None:
        return _there(key, weights, found, "no folder or file here, and no `owner/name` of the hub")
    was = before.get(part, {}).get("weights", "")
    stays = was.startswith(f"{hub.name}@") and before["config"][section].get(name) == written
    return {**found, "weights": was if stays else at_commit(weights, key)}


def _there(key: str, weights: str, found: dict[str, Any], wanted: str) -> dict[str, Any]:
    """What was found of weights on the disk; they must be there now, or they would come as those of another build.

    Raises:
        ConfigError: if they are not, saying what is wanted.
    """
    if "sha256" in found:
        return found
    lack = "holds no weights" if Path(weights).exists() else f"is not there: {wanted}"
    raise ConfigError(f"{key}: {weights!r} {lack}")


def robot_input(config: Config) -> dict[str, Any]:
    """Names and bytes of the files of the robot, as one hash; nothing where it has a name.

    Raises:
        ConfigError: if there is no such file, or it names others outside its folder.
    """
    path = Path(config.trajectories.robot)
    if path.suffix != ".xml":
        return {}
    from tableverse_factory.physics.mjcf.file_check import check_files  # it brings MuJoCo, which few builds need here

    if not path.is_file():
        raise ConfigError(f"trajectories.robot: {path} is no file; give the MJCF of an arm, or a name")
    try:
        files = check_files(path, path.parent)
    except InputError as error:
        raise ConfigError(f"trajectories.robot: {path.name}: {error}") from error
    home = path.parent.resolve()
    digests = sorted(f"{p.resolve().relative_to(home)} {content_hash(p.read_bytes())}".encode() for p in files)
    return {"robot": {"sha256": content_hash(*digests), "files": len(files)}}


def _answers(folder: Path) -> dict[str, Any]:
    """Names and bytes of recorded answers, as one hash."""
    if not folder.is_dir():
        raise ConfigError(f"curate.replay_dir: {folder} is no folder; give the one with <scene_id>.json in it")
    files = sorted(path for path in folder.glob("*.json") if path.is_file())
    if not files:
        raise ConfigError(f"curate.replay_dir: {folder} holds no answers; give the one with <scene_id>.json in it")
    digests = (f"{path.name} {content_hash(path.read_bytes())}".encode() for path in files)
    return {"sha256": content_hash(*digests), "files": len(files)}


def _fingerprint(config: Config, recorded: Mapping[str, Any]) -> str:
    return _with_recorded(fingerprint(config), recorded)


def _with_recorded(own: str, recorded: Mapping[str, Any]) -> str:
    return content_hash(own.encode(), json.dumps(recorded, sort_keys=True).encode()) if recorded else own


def write_run(path: StoragePath, record: Mapping[str, Any]) -> None:
    """Writes run.json, durably."""
    write_atomic(path, (json.dumps(record, indent=2, sort_keys=True) + "\n").encode())


def read_run(path: StoragePath) -> dict[str, Any]:
    """Reads run.json back.

    Raises:
        BuildError: if there is none, or it is not the record of a build.
    """
    try:
        record = json.loads(read_whole(path))
    except FileNotFoundError:
        raise missing_build_error(path) from None
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
    """What differs between two records of builds, by dotted key: the value before and the one now."""
    old, new = _flat(before), _flat(now)
    derived = ("fingerprint", "stages.")
    keys = sorted(key for key in {*old, *new} if old.get(key) != new.get(key) and not key.startswith(derived))
    return {key: (old.get(key), new.get(key)) for key in keys}


def resume_refused_error(
    out: str, differing: Mapping[str, tuple[Any, Any]], section: str, option: str = ""
) -> BuildError:
    """The error of a build that would not give the bytes of the one that was begun in `out`.

    Args:
        out: The dataset.
        differing: What differs.
        section: The stage from which everything could be computed again; empty where there is none.
        option: What the command calls beginning again from there, where that is not `--from`.
    """
    code = (
        f". {CODE} is tableverse-factory's own code, which a `git pull` changes too: --from computes the stage that it "
        "names and what follows with the code that is here now, and keeps what came before"
    )
    shown = ", ".join(f"{key} was {old!r} and is now {new!r}" for key, (old, new) in [*differing.items()][:_MAX_SHOWN])
    more = f" and {len(differing) - _MAX_SHOWN} more" if len(differing) > _MAX_SHOWN else ""
    again = f"add {option or f'--from {section}'} to compute that stage again and what follows it, " if section else ""
    return BuildError(
        f"{out} was begun as another build: {shown}{more}. "
        f"Go on with what it was begun with (see run.json), {again}or give another OUT"
        f"{code if section and CODE in differing else ''}"
    )


def _flat(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    leaves: dict[str, Any] = {}
    for key, value in tree.items():
        if isinstance(value, Mapping):
            leaves |= _flat(value, f"{prefix}{key}.")
        else:
            leaves[prefix + key] = value
    return leaves


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "absent"
