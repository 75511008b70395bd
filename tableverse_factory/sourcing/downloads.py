"""Many pictures fetched: a bounded number at a time, few of them from one host, in whatever order they end."""

import asyncio
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import httpcore

from schemas.config import ObserveConfig
from tableverse_factory.errors import InputError
from tableverse_factory.reading import open_picture
from tableverse_factory.sourcing.addresses import checked_url
from tableverse_factory.sourcing.fetch import FetchBounds, connections, fetched
from tableverse_factory.sourcing.kept import SUFFIXES, KeptPictures
from tableverse_factory.text import printable


@dataclass(slots=True)
class Downloads:
    """What became of addresses.

    Attributes:
        paths: Where the picture of an address lies.
        refused: Code and detail of the reason why it has none.
        fetched: How many came now; the others of `paths` were there.
    """

    paths: dict[str, Path] = field(default_factory=dict)
    refused: dict[str, tuple[str, str]] = field(default_factory=dict)
    fetched: int = 0


def download(
    urls: Sequence[str],
    kept: KeptPictures,
    bounds: FetchBounds,
    pictures: ObserveConfig,
    on_done: Callable[[int, int], None] = lambda _done, _all: None,
) -> Downloads:
    """Fetches what is not there yet.

    Args:
        urls: Each once, untrusted.
        kept: Where pictures go.
        bounds: On fetching.
        pictures: Bounds on what is kept.
        on_done: Called with how many are done, of how many.

    Raises:
        BuildError: if the disk refuses.
    """
    done = Downloads()
    missing: dict[bytes, deque[str]] = defaultdict(deque)
    for url in urls:
        if (path := kept.find(url)) is not None:
            done.paths[url] = path
            continue
        try:
            missing[checked_url(url).raw_host].append(url)
        except InputError as error:
            done.refused[url] = (error.reason, str(error))
        on_done(len(done.paths) + len(done.refused), len(urls))
    if missing:
        within = replace(bounds, max_bytes=min(bounds.max_bytes, pictures.max_file_bytes))
        fetcher = _Fetcher(
            kept, within, pictures, done, lambda: on_done(len(done.paths) + len(done.refused), len(urls))
        )
        asyncio.run(fetcher.all_of(missing.values()))
    return done


class _Fetcher:
    def __init__(
        self,
        kept: KeptPictures,
        bounds: FetchBounds,
        pictures: ObserveConfig,
        done: Downloads,
        on_done: Callable[[], None],
    ) -> None:
        self._kept, self._bounds, self._pictures = kept, bounds, pictures
        self._done, self._on_done = done, on_done
        self._turns = asyncio.Semaphore(bounds.parallel)
        self._writing = asyncio.Lock()

    async def all_of(self, hosts: Iterable[deque[str]]) -> None:
        """Works off the addresses of every host, at most `per_host` of one at a time."""
        async with connections(self._bounds) as pool:
            runners = [urls for urls in hosts for _ in range(min(self._bounds.per_host, len(urls)))]
            await asyncio.gather(*(self._one_by_one(pool, urls) for urls in runners))

    async def _one_by_one(self, pool: httpcore.AsyncConnectionPool, urls: deque[str]) -> None:
        while urls:
            url = urls.popleft()
            try:
                data = await fetched(pool, url, self._bounds, self._turns)
                suffix = _suffix_of(data, self._pictures)
                async with self._writing:
                    self._done.paths[url] = await asyncio.to_thread(self._kept.keep, url, data, suffix)
                self._done.fetched += 1
            except InputError as error:
                self._done.refused[url] = (error.reason, printable(str(error), 1000))
            self._on_done()


def _suffix_of(data: bytes, bounds: ObserveConfig) -> str:
    """The ending that its first bytes earn.

    Raises:
        InputError: `unreadable_color` if it is no picture of a format that is kept, `picture_too_large`.
    """
    image = open_picture(data, "what it gave", bounds, "unreadable_color")
    if image.format not in SUFFIXES:
        raise InputError(f"it gave {image.format}: JPEG, PNG and WebP are kept", "unreadable_color")
    return SUFFIXES[image.format]
