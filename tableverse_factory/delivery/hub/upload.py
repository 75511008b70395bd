"""A dataset onto the Hugging Face Hub: commits of whole shards, so that what is there is always a dataset.

The library's own upload of a folder makes one commit or many, wherever its files happen to fall; here the first commit
holds what names the dataset (`run.json`, the plan, the card), each of the following whole shards. A reader at any of
them sees an unfinished dataset, as on the disk. Nothing is kept beside the dataset to go on with: the Hub is asked what
it has, by content. Every commit follows the one before it, or what is there is looked at anew: two that publish under
one name do not mix.
"""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from tableverse_factory.core.errors import BuildError
from tableverse_factory.dataset.hub_client import ATTEMPTS, TIMEOUT_S, call_hub, select_transfer
from tableverse_factory.dataset.hub_errors import ChangedError
from tableverse_factory.dataset.hub_names import make_hub_api
from tableverse_factory.delivery.hub.remote_state import HEAD_MESSAGE, RemoteState, inspect_remote
from tableverse_factory.delivery.hub.upload_set import CARD, UploadSet

if TYPE_CHECKING:
    from huggingface_hub import CommitInfo, HfApi

MAX_SHARDS_A_COMMIT = 16
MAX_BYTES_A_COMMIT = 8 * 1024**3

_SLOWEST_BYTES_PER_S = 200_000

Said = Callable[[str], None]
"""Takes a line about what is done next."""


@dataclass(frozen=True, slots=True)
class UploadOptions:
    """How a dataset is to be on the Hub.

    Attributes:
        public: Whether everybody may read it. One that exists must be what is asked for.
        replace: Whether another dataset that is there is taken away.
        card: Whether a card that was edited there is overwritten.
    """

    public: bool = False
    replace: bool = False
    card: bool = False


def upload(contents: UploadSet, name: str, wish: UploadOptions, said: Said) -> str:
    """Uploads what the Hub does not have yet; the same call goes on after a kill.

    Args:
        contents: What goes.
        name: Of the dataset on the Hub, as `OWNER/NAME`; it is made where there is none.
        wish: How it is to be there.
        said: Is told of every commit before it.

    Returns:
        Address of the last commit.

    Raises:
        BuildError: if something else is there, or the dataset is public and was to be private.
        StoreError: if the Hub refuses or fails.
    """
    with _quiet():
        api = make_hub_api()
        call_hub(name, lambda: api.create_repo(name, repo_type="dataset", private=not wish.public, exist_ok=True))
        begun: list[str] = []
        with select_transfer(api, name):
            for attempt in range(1, ATTEMPTS + 1):
                # Once our record is there, another dataset in its place is somebody's who came after us.
                there = inspect_remote(api, contents, name, wish.public, wish.replace and not begun)
                try:
                    return _commit_all(api, contents, name, there, wish.card, begun, said)
                except ChangedError:
                    if attempt == ATTEMPTS:
                        raise
                    said("       somebody else changed it meanwhile: looking again")
    raise AssertionError("the last attempt returns or raises")


def _commit_all(
    api: "HfApi", contents: UploadSet, name: str, there: RemoteState, card: bool, begun: list[str], said: Said
) -> str:
    total, done, last = contents.n_bytes, 0, there.commit
    if kept := there.keeps_card and not card:
        said(f"{CARD} was not written by publish, or was edited on the Hub since: it is kept (--card replaces it)")
    if there.obsolete:
        what = ", ".join(there.obsolete[:5]) + (", …" if len(there.obsolete) > 5 else "")
        said(f"taken away, because the dataset does not have it: {what}")
    for number, (message, files) in enumerate(_commits(contents)):
        paths = [path for path in files if path != CARD or not kept]
        n_bytes = sum(contents.sizes.get(path, len(contents.card)) for path in paths)
        said(f"{done * 100 // total:3d} %  {message}, {n_bytes / 1e6:,.1f} MB …")
        obsolete = there.obsolete if number == 0 else ()
        info = _commit(api, contents, name, message, paths, obsolete, last)
        begun.append(message)
        last, done = str(info.oid), done + n_bytes
    said("100 %")
    return str(info.commit_url)


def _commits(contents: UploadSet) -> Iterator[tuple[str, list[str]]]:
    """Messages of the commits, and the paths of their files."""
    yield HEAD_MESSAGE, [CARD, *contents.head()]
    batch: list[int] = []
    for shard in contents.shards:
        batch.append(shard)
        files = [path for number in batch for path in contents.files_of(number)]
        large = sum(contents.sizes[path] for path in files) >= MAX_BYTES_A_COMMIT
        if large or len(batch) == MAX_SHARDS_A_COMMIT or shard == contents.shards[-1]:
            which = f"Shard {shard}" if len(batch) == 1 else f"Shards {batch[0]} to {shard}"
            yield f"{which} of {contents.n_shards}", files
            batch = []
    if repeated := list(contents.tail()):
        yield "Merged tables", repeated


def _commit(
    api: "HfApi",
    contents: UploadSet,
    name: str,
    message: str,
    paths: list[str],
    obsolete: tuple[str, ...],
    parent: str,
) -> "CommitInfo":
    """One commit of what differs from what is there; none where nothing does."""

    def commit() -> "CommitInfo":
        operations = _operations(contents, paths, obsolete)
        return api.create_commit(name, operations, commit_message=message, repo_type="dataset", parent_commit=parent)

    n_bytes = sum(contents.sizes.get(path, 0) for path in paths)
    return call_hub(name, commit, TIMEOUT_S + n_bytes / _SLOWEST_BYTES_PER_S)


def _operations(contents: UploadSet, paths: list[str], obsolete: tuple[str, ...]) -> list[Any]:
    """New ones for every attempt: the library writes into them."""
    from huggingface_hub import CommitOperationAdd, CommitOperationDelete

    found: list[Any] = [CommitOperationDelete(path) for path in obsolete]
    for path in paths:
        if path == CARD:
            found.append(CommitOperationAdd(path, contents.card))
        elif (contents.out / path).is_file():
            found.append(CommitOperationAdd(path, contents.out / path))
        else:
            raise BuildError(f"{contents.out / path} is gone since the upload began: run the same command again")
    return found


@contextmanager
def _quiet() -> Iterator[None]:
    """Keeps addresses, which may be signed, out of logs, and bars of progress out of what is no terminal."""
    from huggingface_hub.utils import are_progress_bars_disabled, disable_progress_bars, enable_progress_bars, logging

    before, bars = logging.get_verbosity(), not are_progress_bars_disabled()
    logging.set_verbosity_error()
    if bars and not sys.stderr.isatty():
        disable_progress_bars()
    try:
        yield
    finally:
        logging.set_verbosity(before)
        if bars:
            enable_progress_bars()
