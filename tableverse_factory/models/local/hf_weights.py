"""Names of weights: paths, or repositories on the Hugging Face Hub with a revision."""

import re
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from tableverse_factory.core.errors import InputError, WeightsError
from tableverse_factory.core.optional_imports import import_extra
from tableverse_factory.core.text import redact_secrets
from tableverse_factory.core.timeouts import call_with_timeout
from tableverse_factory.models.local.catalogue import BY_REPOSITORY

GIT_HASH = re.compile(r"[0-9a-f]{40}")  # of a commit, and of a small file
HUB_TIMEOUT_S = 60.0  # limit for the hub to resolve a revision [s]

_NAME = re.compile(r"(?P<name>[\w.-]+/[\w.-]+)(@(?P<revision>[\w./-]+))?", re.ASCII)
_UNREACHABLE = {
    *("LocalEntryNotFoundError", "OfflineModeIsEnabled", "RevisionResolutionError", "ConnectError"),
    *("ConnectTimeout", "ReadTimeout", "TimeoutError", "ConnectionError"),
}


@dataclass(frozen=True, slots=True)
class HubWeights:
    """A repository on the hub, `owner/name`, and its branch, tag or commit; empty for the newest commit."""

    name: str
    revision: str


def parse_hub_name(weights: str) -> HubWeights | None:
    """Parse `owner/name[@revision]`; None for a path, which starts with `.`, `/` or `~` or is no such name."""
    found = None if weights.startswith((".", "/", "~")) else _NAME.fullmatch(weights)
    return found and HubWeights(found["name"], found["revision"] or "")


def resolve_hub_name(weights: str, key: str) -> HubWeights | None:
    """Parse the repository that weights name, see `parse_hub_name`; WeightsError if a path has the same name.

    The meaning of a configuration must not depend on the working directory.
    """
    found = parse_hub_name(weights)
    if found is None:
        return None
    here = next((name for name in (weights, found.name) if Path(name).exists()), "")
    if here:
        raise WeightsError(
            f"{key} = {weights!r} may be a name on the hub or what lies here: write './{here}' for what lies here, or "
            f"run the command where nothing is called {here!r} for the hub"
        )
    return found


def resolve_source(weights: str, key: str) -> tuple[str, dict[str, str]]:
    """Return the arguments of `from_pretrained`: a path, or a name on the hub and its revision.

    Raises:
        WeightsError: if there is no such path, or as `resolve_hub_name`.
    """
    hub = resolve_hub_name(weights, key)
    if hub is not None:
        return hub.name, {"revision": hub.revision} if hub.revision else {}
    if not Path(weights).exists():
        raise WeightsError(
            f"{key} = {weights!r}: no such folder here, and no `owner/name` or `owner/name@revision` of the hub"
        )
    return weights, {}


def pin_commit(weights: str, key: str) -> str:
    """Return `owner/name@COMMIT` of weights on the hub, from the local cache if it knows the revision.

    Raises:
        WeightsError: if the hub has no such weights or cannot be reached, or its client is too old.
    """
    hub = resolve_hub_name(weights, key)
    if hub is None or GIT_HASH.fullmatch(hub.revision):
        return weights
    try:
        module: Any = import_extra("huggingface_hub", f"{key} = {weights!r}", "models")
    except InputError as error:
        raise WeightsError(str(error)) from None
    if not hasattr(module.HfApi, "resolve_revision"):
        raise WeightsError(
            f"{key} = {weights!r}: huggingface_hub {module.__version__} is too old to say which commit is meant; "
            f"pip install 'huggingface_hub>=1.26', or name a whole commit: {hub.name}@COMMIT"
        )
    api = module.HfApi(library_name="tableverse-factory")
    resolve = partial(api.resolve_revision, hub.name, revision=hub.revision or None)
    try:
        try:
            commit = resolve(local_files_only=True)
        except module.errors.RevisionResolutionError:
            commit = call_with_timeout(HUB_TIMEOUT_S, resolve, TimeoutError())
    except Exception as error:
        raise WeightsError(describe_load_error(error, weights, key)) from error
    return f"{hub.name}@{commit.resolved}"


def describe_load_error(error: BaseException, weights: str, key: str) -> str:
    """Describe in one line why weights cannot be loaded, and what to do."""
    name, _, revision = weights.partition("@")
    if refusal := describe_refusal(error, weights, key):
        return refusal
    if is_unreachable(error):
        return (
            f"{key} = {weights!r} is not on this machine and the hub cannot be reached: fetch it once with a network "
            f"(`{_suggest_fetch(name, revision)}`), or name a folder that holds it"
        )
    return f"{key} = {weights!r} cannot be loaded: {shorten_error(error)}"


def is_unreachable(error: BaseException) -> bool:
    """Whether an error says that the hub cannot be reached."""
    return bool({type(cause).__name__ for cause in _list_causes(error)} & _UNREACHABLE)


def describe_refusal(error: BaseException, weights: str, key: str) -> str:
    """Describe why the hub refuses weights, and what to do; empty if it does not."""
    causes = {type(cause).__name__ for cause in _list_causes(error)}
    head = f"{key} = {weights!r}"
    name, _, revision = weights.partition("@")
    if "GatedRepoError" in causes:
        return (
            f"{head} is gated: accept its licence on its page of the hub, and set HF_TOKEN to a token that may read it"
        )
    if "RevisionNotFoundError" in causes:
        return f"{head}: the hub knows no {revision!r} of this model: give a branch, a tag or a whole commit"
    if "RepositoryNotFoundError" in causes or "not a valid model identifier" in str(error):
        shown = "the hub knows no such model, or shows it only to a token (HF_TOKEN)"
        return f"{head}: {shown}; a folder here is written './{name}'"
    return ""


def shorten_error(error: BaseException) -> str:
    """Return the type and the start of the message of an error."""
    return f"{type(error).__name__}: {redact_secrets(str(error))}"


def _suggest_fetch(name: str, revision: str) -> str:
    listed = BY_REPOSITORY.get(name)
    if listed is not None and listed.files and revision == listed.revision:
        return f"tableverse models fetch {listed.name}"
    return f"hf download {name}" + (f" --revision {revision}" if revision else "")


def _list_causes(error: BaseException | None) -> list[BaseException]:
    found: list[BaseException] = []
    while error is not None and len(found) < 20:
        found.append(error)
        error = error.__cause__ or error.__context__
    return found
