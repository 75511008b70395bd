"""Image manifest: a row per entry with an id from its content, also for entries that cannot be used."""

import os
import posixpath
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from functools import partial
from pathlib import Path

from schemas.config import ObserveConfig
from schemas.geometry import Picture
from schemas.identity import content_hash
from schemas.known_length import KnownLength, encode_known_length
from schemas.manifest import ImageRow, SceneKind
from schemas.tables import MANIFEST
from tableverse_factory.core.errors import BuildError, GeometryError, InputError
from tableverse_factory.core.storage.files import StoragePath, parse_path, write_atomic
from tableverse_factory.core.storage.parquet import encode_rows
from tableverse_factory.core.storage.untrusted import exists, open_image, parse_json, read_bytes
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.sources.capture import read_capture
from tableverse_factory.sources.content_hash import hash_entry
from tableverse_factory.sources.discovery import ManifestEntry, discover_entries, name_source_files
from tableverse_factory.sources.focal import read_exif_focal
from tableverse_factory.sources.image_file import decode_upright
from tableverse_factory.sources.known_length import REASON, check_pixels, read_known_length
from tableverse_factory.sources.layout_file import read_layout_file, resolve_mesh_uri
from tableverse_factory.sources.mesh_file import read_mesh_with_colors
from tableverse_factory.sources.urls.fetch_lists import NO_LISTS, NO_ORIGIN, FetchedLists, Origin
from tableverse_factory.sources.urls.image_filter import FilterCriteria, ImageStats, filter_rows, measure_image
from tableverse_factory.sources.urls.lists import COLUMN_ALIASES, MAX_LICENCE_CHARS, MAX_SOURCE_CHARS

MAX_SIDECAR_BYTES = 64 * 1024
_SLUG_CHARS = 40
_FINE = ("", "")  # of a mesh that is not refused
_SOURCE_KEYS = [name for name in COLUMN_ALIASES if name != "url"]


@dataclass(frozen=True, slots=True)
class Manifest:
    """Rows of folders by uri, then of lists in their order, and numbers of ignored files, columns and tags by kind."""

    rows: tuple[ImageRow, ...]
    ignored: dict[str, int]


def make_manifest(
    paths: Sequence[str],
    bounds: ObserveConfig,
    listed: FetchedLists = NO_LISTS,
    criteria: FilterCriteria | None = None,
    on_checked: Callable[[int, int], None] = lambda _done, _all: None,
    known_length: KnownLength | None = None,
) -> Manifest:
    """Make a manifest of `paths` and `listed`: every entry is decoded, and a bad one becomes a row that says why.

    `criteria` are for bare pictures; None accepts all that decode. `on_checked` gets how many are done, of how many.
    `known_length` is of bare pictures that have none of their own.
    """
    found = discover_entries(paths)
    entries = [*((entry, NO_ORIGIN) for entry in found.entries), *listed.entries]
    checks = _EntryChecker(bounds, known_length)
    rows, measured = [], []
    for number, (entry, origin) in enumerate(entries):
        row, stats = checks.make_row(entry, origin, criteria is not None)
        rows.append(row)
        measured.append(stats)
        on_checked(number + 1, len(entries))
    unique = _reject_duplicates(rows)
    if criteria is not None:
        stats_by_id = {row.scene_id: stats for row, stats in zip(unique, measured, strict=True) if stats is not None}
        unique = filter_rows(unique, stats_by_id, criteria)
    return Manifest(unique, {**found.ignored, **listed.ignored, **checks.ignored})


def create_manifest(
    paths: Sequence[str],
    out: str,
    bounds: ObserveConfig | None = None,
    listed: FetchedLists = NO_LISTS,
    criteria: FilterCriteria | None = None,
    on_checked: Callable[[int, int], None] = lambda _done, _all: None,
    known_length: KnownLength | None = None,
) -> Manifest:
    """Make the image manifest of folders and files, with rows for rejected ones, and write it as Parquet.

    Args:
        paths: Folders, which are searched through, and files: captures, layouts and pictures.
        out: The Parquet file to write, a path or URI.
        bounds: On what is decoded; None for the defaults.
        listed: Entries of lists of addresses.
        criteria: Criteria for bare pictures; None accepts all that decode.
        on_checked: Called with the number of checked entries and of all entries.
        known_length: Of bare pictures that have none of their own, such as the camera's height on a fixed stand.

    Raises:
        InputError: if a path does not exist, nothing is found, or `out` cannot be written.

    Example:
        >>> from tableverse_factory.sources.manifest import create_manifest
        >>> manifest = create_manifest(["captures"], "images.parquet")
        >>> sum(not row.rejected for row in manifest.rows)
    """
    place = check_manifest_path(out)
    bounds = ObserveConfig() if bounds is None else bounds
    made = make_manifest(paths, bounds, listed, criteria, on_checked, known_length)
    if not made.rows:
        raise InputError(
            f"nothing found in {', '.join(sanitize_line(path) for path in paths)[:500]}: a capture is a folder with "
            "color.png, depth.png and camera.json; layouts are JSON files; pictures are JPEG, PNG or WebP"
        )
    write_manifest(place, made.rows)
    return made


def check_manifest_path(out: str) -> StoragePath:
    """Parse where a manifest is to be written, and refuse a folder before a hundred thousand pictures are read."""
    place = parse_path(out)
    if isinstance(place, Path) and os.path.isdir(place):  # noqa: PTH112 a name that is too long is said when it is written
        raise InputError(f"{place} is a folder: name the Parquet file to write, such as {place / 'images.parquet'}")
    return place


def write_manifest(path: StoragePath, rows: Iterable[ImageRow]) -> None:
    """Write the rows as Parquet: equal rows give equal bytes."""
    data = encode_rows((row.model_dump(mode="json") for row in rows), MANIFEST)
    try:
        write_atomic(path, data)
    except BuildError as error:
        raise InputError(f"{path}: cannot be written: {error.__cause__}") from None


class _EntryChecker:
    """Checks of entries, with results for files that several entries name."""

    def __init__(self, bounds: ObserveConfig, known_length: KnownLength | None) -> None:
        self.bounds = bounds
        self.known_length = known_length
        self.ignored: Counter[str] = Counter()
        self.digests: dict[str, str] = {}
        self.refused: dict[tuple[str, str], tuple[str, str]] = {}

    def make_row(self, entry: ManifestEntry, origin: Origin, measure: bool) -> tuple[ImageRow, ImageStats | None]:
        digest, source, licence = "", origin.source, origin.licence
        reason, detail = "", ""
        stats, known = None, self.known_length if entry.kind is SceneKind.IMAGE else None
        try:
            if entry.problem is not None:
                raise InputError(entry.problem[1], entry.problem[0])
            digest = hash_entry(entry.kind, entry.uri, self.bounds, self.digests)
            picture = self._decode(entry)
            source, licence, own = _read_provenance(entry, origin)
            known = own or known
            if picture is not None and known is not None:
                check_pixels(known, picture.shape[1], picture.shape[0])
            if picture is not None and measure and entry.kind is SceneKind.IMAGE:
                stats = measure_image(picture)
        except InputError as error:
            reason, detail = error.reason, sanitize_line(str(error), 1000)
        text, identity = encode_known_length(known), digest or content_hash(entry.uri.encode())
        row = ImageRow(
            scene_id=_make_scene_id(entry, content_hash(identity.encode(), text.encode()) if text else identity),
            kind=entry.kind,
            uri=entry.uri,
            name=entry.name,
            content_sha256=digest,
            url=origin.url,
            source=source,
            licence=licence,
            known_length=text,
            rejected=reason,
            rejected_detail=detail,
        )
        return row, stats

    def _decode(self, entry: ManifestEntry) -> Picture | None:
        """Decode everything that belongs to an entry; returns the picture's pixels, None for a layout."""
        if entry.kind is SceneKind.IMAGE:
            data = read_bytes(entry.uri, self.bounds.max_file_bytes, "unreadable_color")
            name = entry.uri.rsplit("/", 1)[-1]
            picture = decode_upright(data, name, self.bounds)
            if ignored := read_exif_focal(open_image(data, name, self.bounds, "unreadable_color")).ignored:
                self.ignored[ignored] += 1
            return picture
        if entry.kind is SceneKind.CAPTURE:
            return read_capture(entry.uri, self.bounds).color
        for mesh in sorted({item.mesh for item in read_layout_file(entry.uri).objects}):
            # Its pictures may lie no farther up than the layout allows.
            key = posixpath.dirname(entry.uri), resolve_mesh_uri(entry.uri, mesh)
            if key not in self.refused:
                self.refused[key] = self._explain_refusal(entry.uri, mesh)
            if self.refused[key] != _FINE:
                raise InputError(*self.refused[key])
        return None

    def _explain_refusal(self, layout: str, mesh: str) -> tuple[str, str]:
        """Read a mesh of a layout with its pictures; returns why it is refused and its reason, or `_FINE`."""
        locate = partial(resolve_mesh_uri, layout)
        try:
            data = read_bytes(locate(mesh), self.bounds.max_file_bytes, "missing_mesh")
            read_mesh_with_colors(mesh, data, locate, self.bounds)
        except InputError as error:
            return str(error), error.reason
        except GeometryError as error:
            return str(error), "bad_mesh"
        return _FINE


def _make_scene_id(entry: ManifestEntry, digest: str) -> str:
    stem = entry.name if entry.kind is SceneKind.CAPTURE else entry.name.rpartition(".")[0] or entry.name
    slug = re.sub(r"[^A-Za-z0-9_]+", "-", stem)[:_SLUG_CHARS].strip("-_")
    return f"{slug or entry.kind.value}-{digest[:12]}"


def _read_provenance(entry: ManifestEntry, origin: Origin) -> tuple[str, str, KnownLength | None]:
    """Read source, licence and known length of a list's entry, or else from a sidecar.

    It is `source.json` in a capture; `NAME.source.json` or it beside a file.

    Raises:
        InputError: `bad_source`: a licence that cannot be read is not taken for none; `bad_known_length`.
    """
    if origin is not NO_ORIGIN:
        known = read_known_length(origin.known_length, "known_length") if origin.known_length else None
        return origin.source, origin.licence, known
    folder, _, name = entry.uri.rpartition("/")
    if entry.kind is SceneKind.CAPTURE:
        candidates = [f"{entry.uri}/source.json"]
    else:
        candidates = [f"{folder}/{source}" for source in name_source_files(name)]
    uri = next((candidate for candidate in candidates if exists(candidate)), None)
    if uri is None:
        return "", "", None
    name = sanitize_line(uri.rpartition("/")[2], 80)
    value = parse_json(read_bytes(uri, MAX_SIDECAR_BYTES, "bad_source"), name, "bad_source")
    if not isinstance(value, dict):
        raise InputError(f'{name}: give {{"source": …, "licence": …}}', "bad_source")
    value = {COLUMN_ALIASES.get(key, key): given for key, given in value.items()}
    _check_spelling(value, name)
    texts = []
    for key, limit in (("source", MAX_SOURCE_CHARS), ("licence", MAX_LICENCE_CHARS)):
        text = value.get(key, "")
        if not isinstance(text, str) or len(text) > limit:
            raise InputError(f"{name}: {key} is no text of at most {limit} characters", "bad_source")
        texts.append(sanitize_line(text, limit))
    given = value.get("known_length")
    if given is not None and entry.kind is SceneKind.LAYOUT:
        raise InputError(f"{name}: a layout is given in metres, so known_length has no use: leave it out", REASON)
    return texts[0], texts[1], None if given is None else read_known_length(given, f"{name}: known_length")


def _check_spelling(value: Mapping[str, object], name: str) -> None:
    """Refuse keys that look like a misspelt one; others are the user's own."""
    for key in sorted(value.keys() - COLUMN_ALIASES):
        if close := get_close_matches(key.lower(), _SOURCE_KEYS, n=1, cutoff=0.8):
            meant = COLUMN_ALIASES[close[0]]
            raise InputError(f"{name}: {sanitize_line(key, 60)!r} is no key: did you mean {meant}?", "bad_source")


def _reject_duplicates(rows: Iterable[ImageRow]) -> tuple[ImageRow, ...]:
    """Reject entries with the content of an earlier one as `duplicate_of`; repeated ids get a number."""
    first_of: dict[tuple[SceneKind, str], ImageRow] = {}
    used: set[str] = set()
    last_number: dict[str, int] = {}  # of each repeated id
    unique = []
    for row in rows:
        scene_id, number = row.scene_id, last_number.get(row.scene_id, 1)
        while scene_id in used:
            number += 1
            scene_id = f"{row.scene_id}-{number}"
        used.add(scene_id)
        last_number[row.scene_id] = number
        row = row.model_copy(update={"scene_id": scene_id})
        if not row.rejected:
            first = first_of.setdefault((row.kind, row.content_sha256), row)
            if first is not row:
                detail = f"same content as {first.scene_id} at {sanitize_line(first.uri, 500)}"
                if row.licence != first.licence:
                    detail += f", which has the licence {first.licence or 'none'}, and this one {row.licence or 'none'}"
                row = row.model_copy(update={"rejected": "duplicate_of", "rejected_detail": detail})
        unique.append(row)
    return tuple(unique)
