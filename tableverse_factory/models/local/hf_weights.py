"""Names of weights: what a path is and what a repository of the hub, and which of its commits is meant."""

import re
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from tableverse_factory.core.errors import InputError, ModelAccessError
from tableverse_factory.core.optional_imports import require_extra
from tableverse_factory.core.timeouts import call_with_timeout

PUBLISHED = {
    "sam2": "facebook/sam2.1-hiera-large",
    "sam3": "facebook/sam3",
    "depth_anything_2": "depth-anything/Depth-Anything-V2-Metric-Indoor-Small-hf",
    "depth_anything_3": "depth-anything/DA3METRIC-LARGE",
    "depth_anything_3_nested": "depth-anything/DA3NESTED-GIANT-LARGE-1.1",
    "moge_2": "Ruicheng/moge-2-vitl",
}
"""Weights by the name of the backend that takes them where none are named."""

PATIENCE_S = 60.0
"""For the hub to say which commit is meant [s]."""

_NAME = re.compile(r"(?P<name>[\w.-]+/[\w.-]+)(@(?P<revision>[\w./-]+))?", re.ASCII)
_COMMIT = re.compile(r"[0-9a-f]{40}")
_MAX_WORDS = 300
_OUT_OF_REACH = frozenset(
    {
        "LocalEntryNotFoundError",
        "OfflineModeIsEnabled",
        "RevisionResolutionError",
        "ConnectError",
        "ConnectTimeout",
        "ReadTimeout",
        "TimeoutError",
        "ConnectionError",
    }
)


@dataclass(frozen=True, slots=True)
class OnHub:
    """A repository of the hub.

    Attributes:
        name: `owner/name`.
        revision: Branch, tag or commit; empty for the newest commit.
    """

    name: str
    revision: str


def hub_name(weights: str) -> OnHub | None:
    """The repository that weights name; None where they are a path: `.`, `/` or `~` first, or no `owner/name`."""
    found = None if weights.startswith((".", "/", "~")) else _NAME.fullmatch(weights)
    return found and OnHub(found["name"], found["revision"] or "")


def on_hub(weights: str, key: str) -> OnHub | None:
    """The repository that weights name, see `hub_name`.

    What a configuration means must not hang on the folder that a command is run in, so a name that could be either is
    refused.

    Args:
        weights: A folder or file, or `owner/name`, which may be followed by `@` and a revision.
        key: The configuration's key, for what is said.

    Raises:
        ModelAccessError: if a folder or file here has the same name.
    """
    found = hub_name(weights)
    if found is None:
        return None
    here = next((name for name in (weights, found.name) if Path(name).exists()), "")
    if here:
        raise ModelAccessError(
            f"{key} = {weights!r} may be a name on the hub or what lies here: write './{here}' for what lies here, or "
            f"run the command where nothing is called {here!r} for the hub"
        )
    return found


def source(weights: str, key: str) -> tuple[str, dict[str, str]]:
    """What a `from_pretrained` is given: a path, or a name on the hub and its revision.

    Raises:
        ModelAccessError: if there is no such path, or as `on_hub`.
    """
    hub = on_hub(weights, key)
    if hub is not None:
        return hub.name, {"revision": hub.revision} if hub.revision else {}
    if not Path(weights).exists():
        raise ModelAccessError(
            f"{key} = {weights!r}: no such folder here, and no `owner/name` or `owner/name@revision` of the hub"
        )
    return weights, {}


def at_commit(weights: str, key: str) -> str:
    """`owner/name@COMMIT` of weights on the hub: by the hub's cache where that knows the revision, else by the hub.

    Raises:
        ModelAccessError: if the hub knows none such, is needed and out of reach, or its client is too old to ask.
    """
    hub = on_hub(weights, key)
    if hub is None or _COMMIT.fullmatch(hub.revision):
        return weights
    try:
        module: Any = require_extra("huggingface_hub", f"{key} = {weights!r}", "models")
    except InputError as error:
        raise ModelAccessError(str(error)) from None
    if not hasattr(module.HfApi, "resolve_revision"):
        raise ModelAccessError(
            f"{key} = {weights!r}: huggingface_hub {module.__version__} is too old to say which commit is meant; "
            f"pip install 'huggingface_hub>=1.26', or name a whole commit: {hub.name}@COMMIT"
        )
    api = module.HfApi(library_name="tableverse-factory")
    resolve = partial(api.resolve_revision, hub.name, revision=hub.revision or None)
    try:
        try:
            commit = resolve(local_files_only=True)
        except module.errors.RevisionResolutionError:
            commit = call_with_timeout(PATIENCE_S, resolve, TimeoutError())
    except Exception as error:
        raise ModelAccessError(why(error, weights, key)) from error
    return f"{hub.name}@{commit.resolved}"


def why(error: BaseException, weights: str, key: str) -> str:
    """One line: what is wrong with weights of the hub, and what to do."""
    causes = {type(cause).__name__ for cause in _chain(error)}
    head = f"{key} = {weights!r}"
    name, _, revision = weights.partition("@")
    if "GatedRepoError" in causes:
        return (
            f"{head} is gated: accept its licence on its page of the hub, and set HF_TOKEN to a token that may read it"
        )
    if "RevisionNotFoundError" in causes:
        return f"{head}: the hub knows no {revision!r} of this model: give a branch, a tag or a whole commit"
    if "RepositoryNotFoundError" in causes or "not a valid model identifier" in str(error):
        return (
            f"{head}: the hub knows no such model, or shows it only to a token (HF_TOKEN); a folder here is written "
            f"'./{name}'"
        )
    if causes & _OUT_OF_REACH:
        at = f" --revision {revision}" if revision else ""
        return (
            f"{head} is not on this machine and the hub cannot be reached: fetch it once with a network "
            f"(`hf download {name}{at}`), or name a folder that holds it"
        )
    return f"{head} cannot be loaded: {short(error)}"


def short(error: BaseException) -> str:
    """Kind and first words of an error."""
    words = " ".join(str(error).split())
    return f"{type(error).__name__}: {words[:_MAX_WORDS]}"


def _chain(error: BaseException | None) -> list[BaseException]:
    found: list[BaseException] = []
    while error is not None and len(found) < 20:
        found.append(error)
        error = error.__cause__ or error.__context__
    return found
