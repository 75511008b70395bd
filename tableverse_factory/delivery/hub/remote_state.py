"""State of a dataset on the Hub at one commit, and what the next commit may do there."""

import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from tableverse_factory.core.errors import BuildError
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.dataset.consolidated_tables import MERGED
from tableverse_factory.dataset.hub_client import call_hub
from tableverse_factory.dataset.hub_folder import HubFolder
from tableverse_factory.dataset.shards import FOLDERS, SPARSE
from tableverse_factory.delivery.hub.upload_set import CARD, UploadSet
from tableverse_factory.run_record import diff_run_records

if TYPE_CHECKING:
    from huggingface_hub import HfApi

HEAD_MESSAGE = "Card, plan and record"  # of the commit with the card; one last written by another commit was edited

_OWN_FOLDERS = (*FOLDERS, *SPARSE, MERGED)
_EXPECTED = frozenset({".gitattributes", CARD})
_MAX_RUN_BYTES = 1024**2
_SHARD = re.compile(r"shard-(\d{5,9})\.[a-z]+")


@dataclass(frozen=True, slots=True)
class RemoteState:
    """State of a repository that an upload may continue."""

    commit: str  # inspected, which the next one must follow
    obsolete: tuple[str, ...]  # to be deleted: files, and whole folders with a slash at their end
    keep_card: bool  # there is one that was not written by an upload


def inspect_remote(api: "HfApi", contents: UploadSet, name: str, public: bool, replace: bool) -> RemoteState:
    """Inspect the repository, and check that `contents` may go there and that its visibility is the requested one."""
    found = call_hub(name, lambda: api.repo_info(name, repo_type="dataset"))
    if found.private is public:
        what, give = ("private", "without --public") if public else ("public", "with --public")
        raise BuildError(f"{name} is {what} on the Hub: run again {give}, or change it in the settings of the dataset")
    commit = str(found.sha)
    entries = call_hub(name, lambda: list(api.list_repo_tree(name, revision=commit, repo_type="dataset")))
    names = {entry.path for entry in entries}
    if "run.json" not in names:
        if others := sorted(names - _EXPECTED):
            raise BuildError(f"{name} holds something else ({sanitize_line(others[0], 80)}): give a new name")
        return RemoteState(commit, (), _is_card_foreign(api, contents, name, commit, names))
    folder = HubFolder(f"{api.endpoint}/datasets/{name}/resolve/{commit}", name, commit)
    differing = diff_run_records(_read_remote_run(folder), json.loads(json.dumps(contents.run)))
    if not differing:
        strays = _find_strays(folder, contents, names)
        return RemoteState(commit, strays, _is_card_foreign(api, contents, name, commit, names))
    if not replace:
        keys = sanitize_line(", ".join(list(differing)[:5]), 200)
        raise BuildError(f"{name} holds another dataset ({keys} differ): give another name, or --replace to replace it")
    return RemoteState(commit, tuple(f"{own}/" for own in _OWN_FOLDERS if own in names), keep_card=False)


def _read_remote_run(folder: HubFolder) -> Mapping[str, Any]:
    """Read run.json; empty if it is malformed."""
    try:
        run = json.loads(folder.cat_file(f"{folder.address}/run.json", 0, _MAX_RUN_BYTES))
    except (ValueError, RecursionError):
        return {}
    return run if isinstance(run, dict) else {}


def _find_strays(folder: HubFolder, contents: UploadSet, names: set[str]) -> tuple[str, ...]:
    """Find files of shards that `contents` has no such file of, or that were never planned: readers would use them."""
    whole, shards = len(contents.shards) == contents.n_shards, frozenset(contents.shards)
    found = []
    for own in (own for own in _OWN_FOLDERS if own in names):
        for file in folder.sizes(own):
            match = _SHARD.fullmatch(file)
            number = int(match[1]) if match else None
            ours = number is not None and (number in shards or number >= contents.n_shards)
            if (whole if own == MERGED else ours) and f"{own}/{file}" not in contents.sizes:
                found.append(f"{own}/{file}")
    return tuple(sorted(found))


def _is_card_foreign(api: "HfApi", contents: UploadSet, name: str, commit: str, names: set[str]) -> bool:
    """Return whether the card was last written by another commit than an upload's, and differs from ours."""
    if CARD not in names:
        return False
    cards = call_hub(name, lambda: api.get_paths_info(name, [CARD], expand=True, revision=commit, repo_type="dataset"))
    git = hashlib.sha1(b"blob %d\0" % len(contents.card) + contents.card, usedforsecurity=False).hexdigest()
    written_by_us = [card.last_commit is not None and card.last_commit.title == HEAD_MESSAGE for card in cards]
    return not all(ours or getattr(card, "blob_id", "") == git for ours, card in zip(written_by_us, cards, strict=True))
