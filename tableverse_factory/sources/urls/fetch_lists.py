"""Lists of addresses as manifest entries: fetched pictures, and reasons for those that failed."""

import posixpath
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import unquote, urlsplit

from schemas.config import ObserveConfig
from schemas.manifest import SceneKind
from tableverse_factory.core.storage.files import redact_uri
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.sources.discovery import MAX_NAME_CHARS, ManifestEntry
from tableverse_factory.sources.urls.addresses import redact_url
from tableverse_factory.sources.urls.downloads import DownloadResult, download_images
from tableverse_factory.sources.urls.fetch import FetchBounds
from tableverse_factory.sources.urls.image_store import ImageStore
from tableverse_factory.sources.urls.lists import ListRow, read_list, summarize_names


@dataclass(frozen=True, slots=True)
class Origin:
    """Provenance of an entry of a list, printable and without secrets."""

    url: str
    source: str
    licence: str
    known_length: str = ""  # JSON, not validated


NO_ORIGIN = Origin("", "", "")  # Origin of entries from folders: a sidecar may state another


@dataclass(frozen=True, slots=True)
class FetchedLists:
    """An entry with its origin per row, numbers of ignored columns by list, of new pictures and of earlier ones."""

    entries: tuple[tuple[ManifestEntry, Origin], ...]
    ignored: dict[str, int]
    fetched: int = 0
    earlier: int = 0


NO_LISTS = FetchedLists((), {})


def fetch_lists(
    lists: Sequence[str],
    pictures: Path,
    fetching: FetchBounds,
    bounds: ObserveConfig,
    on_done: Callable[[int, int], None] = lambda _done, _all: None,
) -> FetchedLists:
    """Fetch every picture of some lists (paths or URIs) that is not in the folder `pictures` yet."""
    rows: list[ListRow] = []
    ignored: Counter[str] = Counter()
    for path in lists:
        found = read_list(path)
        rows += found.rows
        if found.ignored:
            name = posixpath.basename(redact_uri(path))
            ignored[f"column of {name}: {summarize_names(found.ignored)}"] += len(found.ignored)
    urls = dict.fromkeys(row.url for row in rows if row.problem is None)
    done = download_images(list(urls), ImageStore(pictures), fetching, bounds, on_done)
    entries = tuple((_make_entry(row, done), _make_origin(row)) for row in rows)
    return FetchedLists(entries, dict(ignored), done.fetched, len(done.paths) - done.fetched)


def _make_entry(row: ListRow, done: DownloadResult) -> ManifestEntry:
    name = _display_name(row.url)
    path = done.paths.get(row.url)
    if row.problem is None and path is not None:
        return ManifestEntry(SceneKind.IMAGE, str(path), name)
    return ManifestEntry(SceneKind.IMAGE, redact_url(row.url), name, row.problem or done.refused[row.url])


def _make_origin(row: ListRow) -> Origin:
    return Origin(redact_url(row.url), row.source, row.licence, row.known_length)


def _display_name(url: str) -> str:
    try:
        parts = urlsplit(redact_url(url))
        return sanitize_line(unquote(posixpath.basename(parts.path.rstrip("/"))) or parts.netloc, MAX_NAME_CHARS)
    except ValueError:
        return ""
