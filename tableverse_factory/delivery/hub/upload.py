"""Upload of a dataset to the Hugging Face Hub in commits of whole shards, so that every commit is a dataset.

The first commit holds `run.json`, the plan and the card, so that a reader at any commit sees an unfinished dataset, as
on the disk. An upload resumes from what the Hub has, by content. Every commit must follow the inspected one, or the
state is inspected anew, so that two uploads under one name do not mix.
"""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from tableverse_factory.core.errors import BuildError
from tableverse_factory.dataset.hub_client import RETRY_POLICY, TIMEOUT_S, call_hub, select_transfer
from tableverse_factory.dataset.hub_errors import ChangedError
from tableverse_factory.dataset.hub_names import make_hub_api
from tableverse_factory.delivery.hub.remote_state import HEAD_MESSAGE, RemoteState, inspect_remote
from tableverse_factory.delivery.hub.upload_set import CARD, UploadSet

if TYPE_CHECKING:
    from huggingface_hub import CommitInfo, HfApi

MAX_SHARDS_A_COMMIT = 16
MAX_BYTES_A_COMMIT = 8 * 1024**3

_SLOWEST_BYTES_PER_S = 200_000

Report = Callable[[str], None]  # takes a line before every commit


@dataclass(frozen=True, slots=True)
class UploadOptions:
    """Options of an upload: its visibility, which an existing dataset must have, and what may be overwritten."""

    public: bool = False
    replace: bool = False  # another dataset under this name
    card: bool = False  # a card that was edited on the Hub


def upload(contents: UploadSet, name: str, options: UploadOptions, report: Report) -> str:
    """Upload what the Hub does not have yet to `OWNER/NAME`, created if missing; the same call resumes after a kill."""
    with _silence_library():
        api = make_hub_api()
        call_hub(name, lambda: api.create_repo(name, repo_type="dataset", private=not options.public, exist_ok=True))
        committed: list[str] = []
        with select_transfer(api, name):
            for attempt in range(1, RETRY_POLICY.attempts + 1):
                # Once our record is there, another dataset in its place came after it and must stay.
                state = inspect_remote(api, contents, name, options.public, options.replace and not committed)
                try:
                    return _commit_all(api, contents, name, state, options.card, committed, report)
                except ChangedError:
                    if attempt == RETRY_POLICY.attempts:
                        raise
                    report("       another process changed it meanwhile: inspecting it again")
    raise AssertionError("the last attempt returns or raises")


def _commit_all(
    api: "HfApi", contents: UploadSet, name: str, state: RemoteState, card: bool, committed: list[str], report: Report
) -> str:
    total, done, last = contents.n_bytes, 0, state.commit
    if kept := state.keep_card and not card:
        report(f"{CARD} was not written by publish, or was edited on the Hub since: it is kept (--card replaces it)")
    if state.obsolete:
        what = ", ".join(state.obsolete[:5]) + (", …" if len(state.obsolete) > 5 else "")
        report(f"deleted, because the dataset does not have it: {what}")
    for number, (message, files) in enumerate(_plan_commits(contents)):
        paths = [path for path in files if path != CARD or not kept]
        n_bytes = sum(contents.sizes.get(path, len(contents.card)) for path in paths)
        report(f"{done * 100 // total:3d} %  {message}, {n_bytes / 1e6:,.1f} MB …")
        obsolete = state.obsolete if number == 0 else ()
        info = _commit(api, contents, name, message, paths, obsolete, last)
        committed.append(message)
        last, done = str(info.oid), done + n_bytes
    report("100 %")
    return str(info.commit_url)


def _plan_commits(contents: UploadSet) -> Iterator[tuple[str, list[str]]]:
    """Plan the messages of the commits, and the paths of their files."""
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
    api: "HfApi", contents: UploadSet, name: str, message: str, paths: list[str], obsolete: tuple[str, ...], parent: str
) -> "CommitInfo":
    """Commit what differs from the state of the Hub; nothing is sent if nothing does."""

    def commit() -> "CommitInfo":
        operations = _make_operations(contents, paths, obsolete)
        return api.create_commit(name, operations, commit_message=message, repo_type="dataset", parent_commit=parent)

    n_bytes = sum(contents.sizes.get(path, 0) for path in paths)
    return call_hub(name, commit, TIMEOUT_S + n_bytes / _SLOWEST_BYTES_PER_S)


def _make_operations(contents: UploadSet, paths: list[str], obsolete: tuple[str, ...]) -> list[Any]:
    """Make new operations for every attempt: the library writes into them."""
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
def _silence_library() -> Iterator[None]:
    """Keep addresses, which may be signed, out of logs, and progress bars out of what is no terminal."""
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
