"""Parallel downloads of pictures, bounded in all and for each host."""

import asyncio
from collections import deque
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import httpcore

from schemas.config import ObserveConfig
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.storage.untrusted import open_image
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.sources.urls.addresses import parse_url
from tableverse_factory.sources.urls.fetch import FetchBounds, HostRateLimiter, fetch_bytes, open_connections
from tableverse_factory.sources.urls.image_store import SUFFIXES, ImageStore

MAX_HOST_FAILURES = 5  # Unreachable addresses of a host in a row, after which the rest of them are skipped in this run
_TASKS_PER_REQUEST = 8
"""Pictures in flight for each request: most of them wait for a slot, or because their server asks to."""


@dataclass(slots=True)
class DownloadResult:
    """Pictures by address, code and detail of why others have none, and how many pictures were fetched now."""

    paths: dict[str, Path] = field(default_factory=dict)
    refused: dict[str, tuple[str, str]] = field(default_factory=dict)
    fetched: int = 0


def download_images(
    urls: Sequence[str],
    store: ImageStore,
    bounds: FetchBounds,
    pictures: ObserveConfig,
    on_done: Callable[[int, int], None] = lambda _done, _all: None,
) -> DownloadResult:
    """Download the pictures of untrusted addresses, each named once, that are not in the store yet."""
    result = DownloadResult()
    missing: dict[bytes, _HostQueue] = {}
    for url in urls:
        if (path := store.find(url)) is not None:
            result.paths[url] = path
            continue
        try:
            missing.setdefault(parse_url(url).raw_host, _HostQueue()).urls.append(url)
        except InputError as error:
            result.refused[url] = (error.reason, str(error))
        on_done(len(result.paths) + len(result.refused), len(urls))
    if missing:
        within = replace(bounds, max_bytes=min(bounds.max_bytes, pictures.max_file_bytes))
        fetcher = _Fetcher(
            store, within, pictures, result, lambda: on_done(len(result.paths) + len(result.refused), len(urls))
        )
        asyncio.run(fetcher.fetch_all(missing.values()))
    return result


@dataclass(slots=True)
class _HostQueue:
    urls: list[str] = field(default_factory=list)
    failures: int = 0


class _Fetcher:
    def __init__(
        self,
        store: ImageStore,
        bounds: FetchBounds,
        pictures: ObserveConfig,
        result: DownloadResult,
        on_done: Callable[[], None],
    ) -> None:
        self._store, self._bounds, self._pictures = store, bounds, pictures
        self._result, self._on_done = result, on_done
        self._turns = HostRateLimiter(bounds)
        self._writing = asyncio.Lock()

    async def fetch_all(self, hosts: Collection[_HostQueue]) -> None:
        for host in hosts:
            host.urls.reverse()  # they are taken from the end
        waiting = deque(host for host in hosts for _ in range(min(self._bounds.per_host, len(host.urls))))
        async with open_connections(self._bounds) as pool:
            tasks = min(len(waiting), _TASKS_PER_REQUEST * self._bounds.parallel)
            await asyncio.gather(*(self._fetch_queue(pool, waiting) for _ in range(tasks)))

    async def _fetch_queue(self, pool: httpcore.AsyncConnectionPool, waiting: deque[_HostQueue]) -> None:
        while waiting:
            host = waiting.popleft()
            while host.urls:
                await self._fetch_one(pool, host.urls.pop(), host)

    async def _fetch_one(self, pool: httpcore.AsyncConnectionPool, url: str, host: _HostQueue) -> None:
        try:
            if host.failures >= MAX_HOST_FAILURES:
                raise InputError(f"not asked: {host.failures} others of its host were out of reach", "unreachable")
            data = await fetch_bytes(pool, url, self._bounds, self._turns)
            host.failures = 0
            suffix = _detect_suffix(data, self._pictures)
            async with self._writing:
                self._result.paths[url] = await asyncio.to_thread(self._store.store, url, data, suffix)
            self._result.fetched += 1
        except InputError as error:
            if host.failures < MAX_HOST_FAILURES:
                host.failures = host.failures + 1 if error.reason == "unreachable" else 0
            self._result.refused[url] = (error.reason, sanitize_line(str(error), 1000))
        self._on_done()


def _detect_suffix(data: bytes, bounds: ObserveConfig) -> str:
    image = open_image(data, "what it gave", bounds, "unreadable_color")
    if image.format not in SUFFIXES:
        raise InputError(f"it gave {image.format}: JPEG, PNG and WebP are kept", "unreadable_color")
    return SUFFIXES[image.format]
