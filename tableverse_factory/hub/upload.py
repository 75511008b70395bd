"""A dataset onto the Hugging Face Hub: commits of whole shards, so that what is there is always a dataset.

The library's own upload of a folder makes one commit or many, wherever its files happen to fall; here the first commit
holds what names the dataset (`run.json`, the plan, the card), each of the following whole shards. A reader at any of
them sees an unfinished dataset, as on the disk. Nothing is kept beside the dataset to go on with: the Hub is asked what
it has, by content.
"""

import json
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from tableverse_factory.errors import BuildError, StoreError
from tableverse_factory.hub.contents import CARD, Contents
from tableverse_factory.hub.names import hub_api
from tableverse_factory.hub.problems import passes, said_plainly, wait_asked_for
from tableverse_factory.merged import MERGED
from tableverse_factory.provenance import differences
from tableverse_factory.shards import FOLDERS, SPARSE
from tableverse_factory.text import printable

if TYPE_CHECKING:
    from huggingface_hub import HfApi

MAX_SHARDS_A_COMMIT = 16
MAX_BYTES_A_COMMIT = 8 * 1024**3

_ATTEMPTS = 5
_BACKOFF_S = 2.0
_LONGEST_WAIT_S = 300.0
_OWN_FOLDERS = (*FOLDERS, *SPARSE, MERGED)
_EXPECTED = frozenset({".gitattributes", CARD})
_MAX_RUN_BYTES = 1024**2

Said = Callable[[str], None]
"""Takes a line about what has been done."""


def upload(contents: Contents, name: str, public: bool, replace: bool, said: Said) -> str:
    """Uploads what the Hub does not have yet; the same call goes on after a kill.

    Args:
        contents: What goes.
        name: Of the dataset on the Hub, as `OWNER/NAME`; it is made where there is none.
        public: Whether everybody may read it. One that exists must be what is asked for.
        replace: Whether another dataset that is there is taken away.
        said: Is told of every commit.

    Returns:
        Address of the last commit.

    Raises:
        BuildError: if something else is there, or the dataset is public and was to be private.
        StoreError: if the Hub refuses or fails.
    """
    with said_plainly(name), _quiet():
        api = hub_api()
        _again(lambda: api.create_repo(name, repo_type="dataset", private=not public, exist_ok=True))
        obsolete = _check_repository(api, contents, name, public, replace)
        return _commit_all(api, contents, name, obsolete, said)


def _commit_all(api: "HfApi", contents: Contents, name: str, obsolete: Sequence[str], said: Said) -> str:
    address = ""
    total, done = contents.n_bytes, 0
    for number, (message, paths) in enumerate(_commits(contents)):
        deleted = obsolete if number == 0 else ()
        address = _again(lambda: _commit(api, contents, name, message, paths, deleted))  # noqa: B023 called at once
        done += sum(contents.sizes.get(path, len(contents.card)) for path in paths)
        said(f"{done * 100 // total:3d} %  {message}")
    return address


def _commits(contents: Contents) -> Iterator[tuple[str, list[str]]]:
    """Messages of the commits, and the paths of their files."""
    yield "Card, plan and record", [CARD, *contents.head()]
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
    api: "HfApi", contents: Contents, name: str, message: str, paths: Sequence[str], deleted: Sequence[str]
) -> str:
    """One commit of what differs from what is there; none where nothing does."""
    from huggingface_hub import CommitOperationAdd, CommitOperationDelete

    operations: list[Any] = [CommitOperationDelete(path) for path in deleted]
    operations += [CommitOperationAdd(path, contents.card if path == CARD else contents.out / path) for path in paths]
    return str(api.create_commit(name, operations, commit_message=message, repo_type="dataset").commit_url)


def _check_repository(api: "HfApi", contents: Contents, name: str, public: bool, replace: bool) -> list[str]:
    """What of another dataset is to be taken away; an error where it may not be, or is not ours at all."""
    found = _again(lambda: api.repo_info(name, repo_type="dataset"))
    if found.private is public:
        what, give = ("private", "without --public") if public else ("public", "with --public")
        raise BuildError(f"{name} is {what} on the Hub: run again {give}, or change it in the settings of the dataset")
    there = {entry.path for entry in _again(lambda: list(api.list_repo_tree(name, repo_type="dataset")))}
    if "run.json" not in there:
        if others := sorted(there - _EXPECTED):
            raise BuildError(f"{name} holds something else ({printable(others[0], 80)}): give a new name")
        return []
    theirs = _again(lambda: _run_of(api, name, str(found.sha)))
    differing = differences(theirs, json.loads(json.dumps(contents.run)))
    if not differing:
        return []
    if not replace:
        keys = printable(", ".join(list(differing)[:5]), 200)
        raise BuildError(f"{name} holds another dataset ({keys} differ): give another name, or --replace to replace it")
    return [f"{folder}/" for folder in _OWN_FOLDERS if folder in there]


def _run_of(api: "HfApi", name: str, commit: str) -> dict[str, Any]:
    """The record of the dataset that is there; empty where it is none."""
    from tableverse_factory.hub.folder import HubFolder

    folder = HubFolder(f"{api.endpoint}/datasets/{name}/resolve/{commit}", name, commit)
    try:
        run = json.loads(folder.cat_file(f"{folder.address}/run.json", 0, _MAX_RUN_BYTES))
    except (ValueError, RecursionError):
        return {}
    return run if isinstance(run, dict) else {}


def _again(ask: Callable[[], Any]) -> Any:
    """What `ask` gives, asked again where the Hub is busy; what it has by then is not sent twice."""
    wait = _BACKOFF_S
    for attempt in range(1, _ATTEMPTS + 1):
        try:
            return ask()
        except Exception as error:
            asked = wait_asked_for(error)
            if attempt == _ATTEMPTS or not passes(error) or (asked or 0.0) > _LONGEST_WAIT_S:
                raise
            time.sleep(wait if asked is None else asked)
            wait = min(2 * wait, _LONGEST_WAIT_S)
    raise StoreError("the last attempt returns or raises")


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
