"""Models of transformers with their weights: read once per process, from a folder or the hub, and let go together."""

import gc
import os
import sys
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any, TypeVar

from tableverse_factory.errors import InputError, ModelAccessError
from tableverse_factory.extras import needed
from tableverse_factory.neural.batches import first_line, is_out_of_memory
from tableverse_factory.neural.device import Device, torch_here

_Model = TypeVar("_Model")
_LOADED: dict[tuple[object, ...], Any] = {}
_MAX_WORDS = 300
_UNREADABLE = (OSError, ValueError, KeyError, TypeError, AttributeError, RuntimeError, ImportError)
"""What transformers raises for a configuration or weights of another model; bugs of ours look different."""


def loaded(key: tuple[object, ...], make: Callable[[], _Model]) -> _Model:
    """The model under this key, made by the first who asks for it in this process."""
    if key not in _LOADED:
        _LOADED[key] = make()
    model: _Model = _LOADED[key]
    return model


def release() -> None:
    """Lets go of every model of this process, and of the memory that torch keeps on a GPU for the next one."""
    _LOADED.clear()
    gc.collect()
    torch = sys.modules.get("torch")
    if torch is not None and torch.cuda.is_available() and torch.cuda.is_initialized():
        torch.cuda.empty_cache()


def pretrained(
    architecture: str,
    weights: str,
    device: Device,
    key: str,
    kinds: Collection[str],
    exact: Collection[str] = (),
) -> Any:
    """A model of transformers, ready to be asked: its weights from safetensors alone, and no code from the hub.

    Args:
        architecture: Name of its class in transformers.
        weights: A folder, or `owner/name` on the hub; looked for in the hub's cache first, so that a build with
            everything on the disk asks nobody.
        device: Where it goes, and in which precision.
        key: The configuration's key that names the weights, for what is said when they are none.
        kinds: `model_type`s of configurations that describe such a model.
        exact: Parts of it that stay in float32 whatever the precision, by their names.

    Raises:
        ModelAccessError: without transformers, without weights, or with those of something else.
    """
    torch_here()
    try:
        transformers: Any = needed("transformers", f"{key} = {weights!r}", "models")
    except InputError as error:
        raise ModelAccessError(str(error)) from None
    transformers.utils.logging.set_verbosity_error()
    transformers.utils.logging.disable_progress_bar()
    kind = getattr(transformers, architecture)
    is_folder = _is_folder(weights, key)
    try:
        model, found = _read(kind, weights, local_only=True)
    except _UNREADABLE as error:
        if is_folder or _offline():
            raise ModelAccessError(_why_not(architecture, error, weights, key, is_folder=is_folder)) from error
        try:
            model, found = _read(kind, weights, local_only=False)
        except _UNREADABLE as again:
            raise ModelAccessError(_why(again, weights, key, is_folder=False)) from again
    described = getattr(model.config, "model_type", "")
    missing = [*found["missing_keys"], *found["mismatched_keys"]]
    if missing or described not in kinds:
        what = f"{len(missing)} of its weights are not there" if missing else f"it describes a {described!r}"
        raise ModelAccessError(f"{key} = {weights!r} holds no {architecture}: {what}; name weights of that model")
    return on_device(model, device, exact)


def on_device(model: Any, device: Device, exact: Collection[str] = ()) -> Any:
    """The model where it is to run and in its precision, but for the parts named, which stay in float32.

    Raises:
        ModelAccessError: where it does not fit into the memory.
    """
    model.eval().requires_grad_(False)
    kept = {name: part for name, part in model.named_children() if name in exact}
    for name in kept:
        delattr(model, name)
    try:
        model.to(device.where, device.dtype)
        for name, part in kept.items():
            model.add_module(name, part.to(device.where))
    except RuntimeError as error:
        if is_out_of_memory(error):
            raise does_not_fit(error) from None
        raise
    return model


def does_not_fit(error: BaseException) -> ModelAccessError:
    """The error of a model whose weights are more than the memory holds."""
    return ModelAccessError(
        "a model does not fit into the memory here: give it a GPU with more of it free, smaller weights, or set "
        f"models.device to 'cpu' ({first_line(error)})"
    )


def foreign(make: Callable[[], _Model], weights: str, key: str) -> _Model:
    """A model by a package that is on git alone, which may raise anything where its weights are none.

    Raises:
        ModelAccessError: in one line, whatever it raises.
    """
    try:
        return make()
    except Exception as error:
        if is_out_of_memory(error):
            raise does_not_fit(error) from error
        raise ModelAccessError(_why(error, weights, key, is_folder=Path(weights).exists())) from error


def absolute(weights: str) -> str:
    """The same weights for a process that lives elsewhere: a folder or file by its whole path, the hub's by name."""
    return str(Path(weights).resolve()) if weights and Path(weights).exists() else weights


def _read(kind: Any, weights: str, *, local_only: bool) -> tuple[Any, dict[str, Any]]:
    model, found = kind.from_pretrained(
        weights,
        dtype=torch_here().float32,
        use_safetensors=True,
        trust_remote_code=False,
        local_files_only=local_only,
        ignore_mismatched_sizes=True,  # they are refused below, in one line
        output_loading_info=True,
    )
    return model, found


def _is_folder(weights: str, key: str) -> bool:
    """Whether the weights lie on this machine.

    Raises:
        ModelAccessError: where they are meant to and do not, or the name is neither.
    """
    if Path(weights).is_dir():
        return True
    if weights.startswith((".", "/", "~")) or weights.count("/") != 1:
        raise ModelAccessError(f"{key} = {weights!r}: no such folder here, and no `owner/name` of the hub")
    return False


def _offline() -> bool:
    return any(os.environ.get(name, "").upper() in ("1", "ON", "YES", "TRUE") for name in _OFFLINE)


_OFFLINE = ("HF_HUB_OFFLINE", "TRANSFORMERS_OFFLINE")


def _why_not(architecture: str, error: BaseException, weights: str, key: str, *, is_folder: bool) -> str:
    """The same of a model of transformers."""
    if is_folder and not any(Path(weights).glob("*.safetensors")):
        return (
            f"{key} = {weights!r}: no *.safetensors in this folder; other files of weights can hold code and are not "
            "read"
        )
    if is_folder:
        return f"{key} = {weights!r} holds no {architecture}: {_short(error)}"
    return _why(error, weights, key, is_folder=False)


def _why(error: BaseException, weights: str, key: str, *, is_folder: bool) -> str:
    """One line: what is wrong with the weights, and what to do."""
    causes = {type(cause).__name__ for cause in _chain(error)}
    head = f"{key} = {weights!r}"
    if is_folder:
        return f"{head} cannot be loaded: {_short(error)}"
    if "GatedRepoError" in causes or "gated repo" in str(error):
        return (
            f"{head} is gated: accept its licence on its page of the hub, and set HF_TOKEN to a token that may read it"
        )
    if "RepositoryNotFoundError" in causes or "not a valid model identifier" in str(error):
        return f"{head}: the hub knows no such model, or shows it only to a token (HF_TOKEN)"
    if causes & {
        "LocalEntryNotFoundError",
        "OfflineModeIsEnabled",
        "ConnectError",
        "ConnectTimeout",
        "ConnectionError",
    }:
        return (
            f"{head} is not on this machine and the hub cannot be reached: fetch it once with a network "
            f"(`hf download {weights}`), or name a folder that holds it"
        )
    return f"{head} cannot be loaded: {_short(error)}"


def _chain(error: BaseException | None) -> list[BaseException]:
    found: list[BaseException] = []
    while error is not None and len(found) < 20:
        found.append(error)
        error = error.__cause__ or error.__context__
    return found


def _short(error: BaseException) -> str:
    words = " ".join(str(error).split())
    return f"{type(error).__name__}: {words[:_MAX_WORDS]}"
