"""Models of transformers with their weights: read once per process, from a folder or the hub, and let go together."""

import gc
import sys
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any, TypeVar

from tableverse_factory.core.errors import InputError, ModelAccessError
from tableverse_factory.core.optional_imports import require_extra
from tableverse_factory.models.local.batches import first_line, is_out_of_memory
from tableverse_factory.models.local.device import Device, torch_here
from tableverse_factory.models.local.hf_weights import short, source, why

_Model = TypeVar("_Model")
_LOADED: dict[tuple[object, ...], Any] = {}
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
        weights: A folder, or `owner/name` or `owner/name@revision` on the hub; looked for in the hub's cache first, so
            that a build with everything on the disk asks nobody.
        device: Where it goes, and in which precision.
        key: The configuration's key that names the weights, for what is said when they are none.
        kinds: `model_type`s of configurations that describe such a model.
        exact: Parts of it that stay in float32 whatever the precision, by their names.

    Raises:
        ModelAccessError: without transformers, without weights, or with those of something else.
    """
    torch_here()
    try:
        transformers: Any = require_extra("transformers", f"{key} = {weights!r}", "models")
    except InputError as error:
        raise ModelAccessError(str(error)) from None
    transformers.utils.logging.set_verbosity_error()
    transformers.utils.logging.disable_progress_bar()
    kind = getattr(transformers, architecture)
    name, at = source(weights, key)
    try:
        model, found = _read(kind, name, at, local_only=True)
    except _UNREADABLE as error:
        if Path(name).exists():
            raise ModelAccessError(_why_no_folder(architecture, error, weights, key)) from error
        try:
            model, found = _read(kind, name, at, local_only=False)
        except _UNREADABLE as again:
            raise ModelAccessError(why(again, weights, key)) from again
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
        raise ModelAccessError(why(error, weights, key)) from error


def absolute(weights: str) -> str:
    """The same weights for a process that lives elsewhere: a folder or file by its whole path, the hub's by name."""
    return str(Path(weights).resolve()) if weights and Path(weights).exists() else weights


def _read(kind: Any, weights: str, at: Mapping[str, str], *, local_only: bool) -> tuple[Any, dict[str, Any]]:
    model, found = kind.from_pretrained(
        weights,
        **at,
        dtype=torch_here().float32,
        use_safetensors=True,
        trust_remote_code=False,
        local_files_only=local_only,
        ignore_mismatched_sizes=True,  # they are refused below, in one line
        output_loading_info=True,
    )
    return model, found


def _why_no_folder(architecture: str, error: BaseException, weights: str, key: str) -> str:
    if not any(Path(weights).glob("*.safetensors")):
        return (
            f"{key} = {weights!r}: no *.safetensors in this folder; other files of weights can hold code and are not "
            "read"
        )
    return f"{key} = {weights!r} holds no {architecture}: {short(error)}"
