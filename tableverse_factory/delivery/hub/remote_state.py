"""What the Hub has under a dataset's name, at one commit, and what a commit after it may do there."""

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

HEAD_MESSAGE = "Card, plan and record"
"""Of the commit that writes the card; whose card was written by another has been edited since."""

_OWN_FOLDERS = (*FOLDERS, *SPARSE, MERGED)
_EXPECTED = frozenset({".gitattributes", CARD})
_MAX_RUN_BYTES = 1024**2
_SHARD = re.compile(r"shard-(\d{5,9})\.[a-z]+")


@dataclass(frozen=True, slots=True)
class RemoteState:
    """The state of a repository that may be gone on from.

    Attributes:
        commit: The one that was looked at; the next one must follow it and no other.
        obsolete: What is to be taken away: files, and whole folders with a slash at their end.
        keeps_card: Whether there is a card that somebody else wrote.
    """

    commit: str
    obsolete: tuple[str, ...]
    keeps_card: bool


def inspect_remote(api: "HfApi", contents: UploadSet, name: str, public: bool, replace: bool) -> RemoteState:
    """What is there, if `contents` may go there.

    Args:
        api: The Hub.
        contents: What is to go.
        name: Of the dataset on the Hub.
        public: Whether everybody is to read it.
        replace: Whether another dataset may be taken away.

    Raises:
        BuildError: if something else is there, or who may read it is not what was asked for.
        StoreError: if the Hub refuses or fails.
    """
    found = call_hub(name, lambda: api.repo_info(name, repo_type="dataset"))
    if found.private is public:
        what, give = ("private", "without --public") if public else ("public", "with --public")
        raise BuildError(f"{name} is {what} on the Hub: run again {give}, or change it in the settings of the dataset")
    commit = str(found.sha)
    entries = call_hub(name, lambda: list(api.list_repo_tree(name, revision=commit, repo_type="dataset")))
    there = {entry.path for entry in entries}
    if "run.json" not in there:
        if others := sorted(there - _EXPECTED):
            raise BuildError(f"{name} holds something else ({sanitize_line(others[0], 80)}): give a new name")
        return RemoteState(commit, (), _keeps_card(api, contents, name, commit, there))
    folder = HubFolder(f"{api.endpoint}/datasets/{name}/resolve/{commit}", name, commit)
    differing = diff_run_records(_run_in(folder), json.loads(json.dumps(contents.run)))
    if not differing:
        strays = _strays(folder, contents, there)
        return RemoteState(commit, strays, _keeps_card(api, contents, name, commit, there))
    if not replace:
        keys = sanitize_line(", ".join(list(differing)[:5]), 200)
        raise BuildError(f"{name} holds another dataset ({keys} differ): give another name, or --replace to replace it")
    return RemoteState(commit, tuple(f"{own}/" for own in _OWN_FOLDERS if own in there), keeps_card=False)


def _run_in(folder: HubFolder) -> Mapping[str, Any]:
    """The record of the dataset that is there; empty where it is none."""
    try:
        run = json.loads(folder.cat_file(f"{folder.address}/run.json", 0, _MAX_RUN_BYTES))
    except (ValueError, RecursionError):
        return {}
    return run if isinstance(run, dict) else {}


def _strays(folder: HubFolder, contents: UploadSet, there: set[str]) -> tuple[str, ...]:
    """Files of shards that `contents` has without such a file, or that were never planned: readers would take them."""
    whole, shards = len(contents.shards) == contents.n_shards, frozenset(contents.shards)
    found = []
    for own in (own for own in _OWN_FOLDERS if own in there):
        for file in folder.sizes(own):
            number = _SHARD.fullmatch(file)
            ours = (
                whole if own == MERGED else number and (int(number[1]) in shards or int(number[1]) >= contents.n_shards)
            )
            if ours and f"{own}/{file}" not in contents.sizes:
                found.append(f"{own}/{file}")
    return tuple(sorted(found))


def _keeps_card(api: "HfApi", contents: UploadSet, name: str, commit: str, there: set[str]) -> bool:
    """Whether another than `publish` wrote the card that is there; one that is the same may be written again."""
    if CARD not in there:
        return False
    cards = call_hub(name, lambda: api.get_paths_info(name, [CARD], expand=True, revision=commit, repo_type="dataset"))
    git = hashlib.sha1(b"blob %d\0" % len(contents.card) + contents.card, usedforsecurity=False).hexdigest()
    written_by_us = [card.last_commit is not None and card.last_commit.title == HEAD_MESSAGE for card in cards]
    return not all(ours or getattr(card, "blob_id", "") == git for ours, card in zip(written_by_us, cards, strict=True))
