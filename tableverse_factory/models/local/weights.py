"""Loading of transformers models with weights, once per process, from a folder or the hub."""

import gc
import sys
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any, TypeVar

from tableverse_factory.core.errors import InputError, WeightsError
from tableverse_factory.core.optional_imports import import_extra
from tableverse_factory.models.local.batches import get_first_line, is_out_of_memory
from tableverse_factory.models.local.device import Device, import_torch
from tableverse_factory.models.local.hf_weights import describe_load_error, resolve_source, shorten_error

_Model = TypeVar("_Model")
_LOADED: dict[tuple[object, ...], Any] = {}
# Errors that transformers raises for a configuration or weights of another model.
_UNREADABLE = (OSError, ValueError, KeyError, TypeError, AttributeError, RuntimeError, ImportError)


def load_once(key: tuple[object, ...], make: Callable[[], _Model]) -> _Model:
    """Return the model of a key, made at the first call in this process."""
    if key not in _LOADED:
        _LOADED[key] = make()
    return _LOADED[key]


def release_models() -> None:
    """Release all models of this process, and the GPU memory that torch caches."""
    _LOADED.clear()
    gc.collect()
    torch = sys.modules.get("torch")
    if torch is not None and torch.cuda.is_available() and torch.cuda.is_initialized():
        torch.cuda.empty_cache()


def load_pretrained(
    architecture: str, weights: str, device: Device, key: str, kinds: Collection[str], exact: Collection[str] = ()
) -> Any:
    """Load a transformers model from safetensors alone, without code from the hub; the local cache is searched first.

    Args:
        architecture: Name of its class in transformers.
        weights: A folder, or `owner/name` or `owner/name@revision` on the hub.
        device: Device and precision.
        key: Key of the configuration that names the weights, for messages.
        kinds: Accepted values of `model_type`.
        exact: Names of child modules that stay in float32 whatever the precision.

    Raises:
        WeightsError: without transformers or weights, or with weights of another model.
    """
    import_torch()
    transformers = _import_transformers(weights, key)
    kind = getattr(transformers, architecture)
    name, at = resolve_source(weights, key)
    try:
        model, found = _load_model(kind, name, at, local_only=True)
    except _UNREADABLE as error:
        if Path(name).exists():
            raise WeightsError(_describe_folder_error(architecture, error, weights, key)) from error
        try:
            model, found = _load_model(kind, name, at, local_only=False)
        except _UNREADABLE as again:
            raise WeightsError(describe_load_error(again, weights, key)) from again
    described = getattr(model.config, "model_type", "")
    missing = [*found["missing_keys"], *found["mismatched_keys"]]
    if missing or described not in kinds:
        what = f"{len(missing)} of its weights are not there" if missing else f"it describes a {described!r}"
        raise WeightsError(f"{key} = {weights!r} holds no {architecture}: {what}; name weights of that model")
    return move_to_device(model, device, exact)


def load_tokenizer(weights: str, key: str, numbers: Mapping[str, int]) -> Any:
    """Load the tokenizer beside the weights of a model, as `load_pretrained` does; without code from the hub.

    `numbers` holds tokens with their numbers: without its files transformers makes a tokenizer that knows no words.

    Raises:
        WeightsError: without transformers, or a tokenizer with these numbers.
    """
    transformers = _import_transformers(weights, key)
    name, at = resolve_source(weights, key)

    def load(*, local_only: bool) -> Any:
        found = transformers.AutoTokenizer.from_pretrained(
            name, **at, trust_remote_code=False, local_files_only=local_only
        )
        if found.convert_tokens_to_ids([*numbers]) != [*numbers.values()]:
            raise ValueError(f"it has no tokens {', '.join(numbers)} of these numbers")
        return found

    try:
        return load(local_only=True)
    except _UNREADABLE as error:
        if Path(name).exists():
            raise WeightsError(f"{key} = {weights!r} holds no tokenizer: {shorten_error(error)}") from error
    return load_foreign(lambda: load(local_only=False), weights, key)


def _import_transformers(weights: str, key: str) -> Any:
    try:
        transformers: Any = import_extra("transformers", f"{key} = {weights!r}", "models")
    except InputError as error:
        raise WeightsError(str(error)) from None
    transformers.utils.logging.set_verbosity_error()
    transformers.utils.logging.disable_progress_bar()
    return transformers


def move_to_device(model: Any, device: Device, exact: Collection[str] = ()) -> Any:
    """Move a model to a device and its precision, but for the child modules in `exact`, which stay in float32."""
    model.eval().requires_grad_(False)
    kept = {name: part for name, part in model.named_children() if name in exact}
    for name in kept:
        delattr(model, name)
    try:
        model.to(device.torch_device, device.dtype)
        for name, part in kept.items():
            model.add_module(name, part.to(device.torch_device))
    except RuntimeError as error:
        if is_out_of_memory(error):
            raise create_memory_error(error) from None
        raise
    return model


def create_memory_error(error: BaseException) -> WeightsError:
    """Create the error for a model that does not fit into the memory."""
    return WeightsError(
        "a model does not fit into the memory here: give it a GPU with more of it free, smaller weights, or set "
        f"models.device to 'cpu' ({get_first_line(error)})"
    )


def load_foreign(make: Callable[[], _Model], weights: str, key: str) -> _Model:
    """Load a model with a foreign package; whatever that raises for bad weights becomes a WeightsError."""
    try:
        return make()
    except Exception as error:
        if is_out_of_memory(error):
            raise create_memory_error(error) from error
        raise WeightsError(describe_load_error(error, weights, key)) from error


def make_absolute(weights: str) -> str:
    """Return weights for a process in another folder: the absolute path of a folder or file, else the name."""
    return str(Path(weights).resolve()) if weights and Path(weights).exists() else weights


def _load_model(kind: Any, weights: str, at: Mapping[str, str], *, local_only: bool) -> tuple[Any, dict[str, Any]]:
    model, found = kind.from_pretrained(
        weights,
        **at,
        dtype=import_torch().float32,
        use_safetensors=True,
        trust_remote_code=False,
        local_files_only=local_only,
        ignore_mismatched_sizes=True,  # they are refused below, in one line
        output_loading_info=True,
    )
    return model, found


def _describe_folder_error(architecture: str, error: BaseException, weights: str, key: str) -> str:
    if not any(Path(weights).glob("*.safetensors")):
        return (
            f"{key} = {weights!r}: no *.safetensors in this folder; other files of weights can hold code and are not "
            "read"
        )
    return f"{key} = {weights!r} holds no {architecture}: {shorten_error(error)}"
