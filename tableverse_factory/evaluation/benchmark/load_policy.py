"""Policies by name: ours, classes of modules and files, and processes behind an HTTP address."""

import importlib
import importlib.util
import os
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from schemas.identity import content_hash
from tableverse_factory.core.errors import ConfigError, InputError, WeightsError
from tableverse_factory.core.file_hash import hash_file
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.evaluation.benchmark.http_policy import HttpPolicy
from tableverse_factory.evaluation.benchmark.policy import Policy, check_policy
from tableverse_factory.evaluation.training.policy.shipped import SHIPPED

_ROOM = "tableverse_factory.evaluation.benchmark"
_TRAINED = "tableverse_factory.evaluation.training.policy"
SHORT_NAMES: Mapping[str, str] = {  # imported when they are asked for, as the planner takes a second
    "planner": f"{_ROOM}.planner:PlannerPolicy",
    "replay": f"{_ROOM}.replay:ReplayPolicy",
    "random": f"{_ROOM}.random_policy:RandomPolicy",
    "state": f"{_TRAINED}.state_policy:StatePolicy",
    "picture": f"{_TRAINED}.picture_policy:PicturePolicy",
}


@dataclass(frozen=True, slots=True)
class PolicyName:
    """Name of a policy as on the command line, the weights that its class is called with, and its title in tables.

    A name is one of `SHORT_NAMES`, `module:Class`, `file.py:Class`, or the address of a process as `http://127.0.0.1:8000`.
    """

    name: str
    weights: str | None = None
    title: str | None = None

    def identify(self) -> tuple[str, str]:
        """Return a digest, and a line on the weights: the start of their own SHA-256, if they are here, and their name.

        The digest is of the name, the class's own file and the weights, a file or folder: others are another run. Of a
        process behind an address only the address is known.
        """
        weights = Path(self.weights or SHIPPED.get(self.name) or "")
        hashed = _hash_path(weights)
        line = f"sha256 {hashed[:12]}, {weights.name}" if weights.name and weights.exists() else weights.name
        parts = self.name, _hash_path(_find_source(self.name)), hashed
        return content_hash(*(part.encode() for part in parts)), sanitize_line(line, 300)

    @property
    def shown(self) -> str:
        """Title, else the name without folders."""
        if self.title is not None:
            return sanitize_line(self.title, 300)
        return sanitize_line(self.name.rpartition("/")[2] if not self.name.startswith("http") else self.name, 300)


def _find_source(name: str) -> Path:
    """Find the file of a class by its name; a module that is not found does not load either."""
    source = name.rpartition(":")[0]
    if name in SHORT_NAMES or name.startswith(("http://", "https://")) or source.endswith(".py"):
        return Path(source)
    with suppress(ImportError, ValueError):
        spec = importlib.util.find_spec(source)
        return Path((spec and spec.origin) or source)
    return Path(source)


def _hash_path(path: Path) -> str:
    """Hash a file, all files of a folder with their names within it, or else the path."""
    if path.is_file():
        return hash_file(path)
    if not (path.name and path.is_dir()):
        return content_hash(os.fsencode(path))
    inside = sorted(each for each in path.rglob("*") if each.is_file())
    named = (part for each in inside for part in (os.fsencode(each.relative_to(path)), hash_file(each).encode()))
    return content_hash(*named)


def load_policy(name: PolicyName) -> Policy:
    """Load a policy; its code runs in this process.

    Raises:
        ConfigError: for a name that is none of the four kinds, or names no class.
        InputError: `bad_policy` if it does not load, or is no policy.
        WeightsError: if its weights, or the packages that run them, are not there.
    """
    if name.name.startswith(("http://", "https://")):
        if name.weights is not None:
            raise ConfigError("--weights: a process behind an address loads its own weights; leave them out")
        return HttpPolicy(name.name)
    make = _find_class(SHORT_NAMES.get(name.name, name.name))
    try:
        policy = make() if name.weights is None else make(name.weights)
    except (ConfigError, InputError, WeightsError):
        raise
    except Exception as error:
        raise _load_error(name.name, error) from error
    return check_policy(policy, sanitize_line(name.name, 200))


def _find_class(name: str) -> Callable[..., Any]:
    source, colon, wanted = name.rpartition(":")
    if not colon or not source or not wanted.isidentifier():
        raise ConfigError(
            f"policy {sanitize_line(name, 200)!r}: give {', '.join(SHORT_NAMES)}, module:Class, file.py:Class or "
            "http://127.0.0.1:PORT"
        )
    try:
        module = _load_file(Path(source)) if source.endswith(".py") else importlib.import_module(source)
    except (ConfigError, InputError, WeightsError):
        raise
    except Exception as error:
        raise _load_error(name, error) from error
    found = getattr(module, wanted, None)
    if not callable(found):
        raise InputError(f"policy {sanitize_line(name, 200)}: there is no class {wanted}", "bad_policy")
    return found


def _load_file(path: Path) -> ModuleType:
    """Load a file as a module; its folder is searched for what it imports."""
    if not path.is_file():
        raise InputError(f"policy: {path} is no file", "bad_policy")
    sys.path.insert(0, str(path.absolute().parent))
    spec = importlib.util.spec_from_file_location(path.stem, path)
    if spec is None or spec.loader is None:
        raise InputError(f"policy: {path} is no file of Python", "bad_policy")
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module
    spec.loader.exec_module(module)
    return module


def _load_error(name: str, error: Exception) -> InputError:
    text = sanitize_line(f"{type(error).__name__}: {' '.join(str(error).split())}", 300)
    return InputError(f"policy {sanitize_line(name, 200)} does not load: {text}", "bad_policy")
