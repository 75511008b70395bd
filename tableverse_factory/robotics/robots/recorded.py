"""Files of a robot as run.json records them."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from schemas.config import Config
from schemas.identity import content_hash
from tableverse_factory.core.errors import ConfigError, InputError


def record_robot(config: Config, _before: Mapping[str, Any]) -> dict[str, Any] | None:
    """Hash the names and bytes of the files of a robot that is given as MJCF; None for a robot with a name."""
    path = Path(config.trajectories.robot)
    if path.suffix != ".xml":
        return None
    from tableverse_factory.physics.mjcf.file_check import check_files  # imports MuJoCo, which few builds need here

    if not path.is_file():
        raise ConfigError(f"trajectories.robot: {path} is no file; give the MJCF of an arm, or a name")
    try:
        files = check_files(path, path.parent)
    except InputError as error:
        raise ConfigError(f"trajectories.robot: {path.name}: {error}") from error
    home = path.parent.resolve()
    digests = sorted(f"{p.resolve().relative_to(home)} {content_hash(p.read_bytes())}".encode() for p in files)
    return {"sha256": content_hash(*digests), "files": len(files)}
