"""Check before a build that a model can be loaded: its packages, device and weights, without loading them."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from schemas.config import ModelsConfig
from tableverse_factory.core.errors import WeightsError
from tableverse_factory.core.optional_imports import import_extra
from tableverse_factory.core.timeouts import call_with_timeout
from tableverse_factory.models.local.catalogue import DEFAULT_WEIGHTS
from tableverse_factory.models.local.device import select_device
from tableverse_factory.models.local.hf_weights import (
    HUB_TIMEOUT_S,
    describe_load_error,
    parse_hub_name,
    pin_commit,
    resolve_source,
    shorten_error,
)

_SAFETENSORS = "*.safetensors"


def check_weights(
    key: str, backend: str, weights: str, config: ModelsConfig, here: bool, pattern: str = _SAFETENSORS
) -> None:
    """Check a model whose weights are files of this pattern, in a folder or on the Hub.

    Args:
        key: Key of the configuration that names the weights, for messages.
        backend: Whose published weights are meant if `weights` is empty.
        weights: As in the configuration.
        config: Device and precision.
        here: Whether the stages run on this machine; else its packages, device, cache and network say nothing.
        pattern: Of the names of the files.

    Raises:
        WeightsError: if a package or the device is missing, or the weights are missing, damaged or out of reach.
    """
    named = weights or DEFAULT_WEIGHTS[backend]
    name, _ = resolve_source(named, key)
    if not here:
        return
    select_device(config)
    folder = Path(name) if parse_hub_name(named) is None else _find_in_cache(named, key)
    files = sorted(folder.glob(pattern)) if folder is not None and folder.is_dir() else []
    for path in files if pattern == _SAFETENSORS else ():
        _check_safetensors(path, named, key)
    if files or (folder is not None and folder.is_file()):
        return
    if parse_hub_name(named) is None:
        raise WeightsError(f"{key} = {named!r}: no {pattern} in this folder; other files of weights are not read")
    _reach_hub(named, key)


def _find_in_cache(named: str, key: str) -> Path | None:
    """Find the folder of weights of the Hub in the cache of this machine."""
    hub = parse_hub_name(pin_commit(named, key))
    if hub is None:
        return None
    found = _import_hub(named, key).try_to_load_from_cache(hub.name, "config.json", revision=hub.revision)
    return Path(found).parent if isinstance(found, str) else None


def _reach_hub(named: str, key: str) -> None:
    """Ask the Hub for a file of the weights, which a build downloads where they are missing."""
    module, hub = _import_hub(named, key), parse_hub_name(pin_commit(named, key))
    if hub is None:
        return
    url = module.hf_hub_url(hub.name, "config.json", revision=hub.revision)
    ask: Callable[[], Any] = partial(module.get_hf_file_metadata, url, library_name="tableverse-factory")
    try:
        call_with_timeout(HUB_TIMEOUT_S, ask, TimeoutError())
    except Exception as error:
        if "EntryNotFound" not in type(error).__name__:
            raise WeightsError(describe_load_error(error, named, key)) from error


def _check_safetensors(path: Path, named: str, key: str) -> None:
    """Read the header of a file of weights, which tells how long the file has to be."""
    safetensors: Any = import_extra("safetensors", f"{key} = {named!r}", "models")
    try:
        with safetensors.safe_open(path, "np"):
            pass
    except Exception as error:  # safetensors' errors have no public base
        raise WeightsError(f"{key} = {named!r}: {path.name} is damaged: {shorten_error(error)}") from error


def _import_hub(named: str, key: str) -> Any:
    return import_extra("huggingface_hub", f"{key} = {named!r}", "models")
