"""Discovery of captures, layouts and pictures in folders, in a fixed order and without following loops."""

import json
import os
import posixpath
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import fsspec
from fsspec.implementations.local import LocalFileSystem

from schemas.layout import Layout
from schemas.manifest import SceneKind
from tableverse_factory.core.errors import InputError, StoreError
from tableverse_factory.core.storage.files import parse_path, redact_uri, resolve_filesystem
from tableverse_factory.core.storage.untrusted import MAX_JSON_BYTES, find_type, parse_json
from tableverse_factory.core.text import describe_error, sanitize_line
from tableverse_factory.geometry.mesh.meshes import MESH_SUFFIXES
from tableverse_factory.sources.capture import CAMERA_NAME, COLOR_NAMES, DEPTH_NAME, DETECTIONS_NAME
from tableverse_factory.sources.content_hash import CAMERA_SUFFIX, DEPTH_SUFFIX

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp")
UNREAD_SUFFIXES = (".avif", ".bmp", ".dng", ".gif", ".heic", ".heif", ".jfif", ".jp2", ".jxl", ".tif", ".tiff")
ASSET_FOLDERS = ("assets", "materials", "meshes", "textures")
MAX_URI_CHARS = 4096
MAX_NAME_CHARS = 200
GROUND_TRUTH_NAME = "truth.json"
RECORDED = "recorded depth or camera of a picture (for observe.depth=recorded)"
_LAYOUT_KEY = re.compile(rb'"(objects(?="\s*:\s*\[)|mesh|frame|pose)"\s*:')


@dataclass(frozen=True, slots=True)
class ManifestEntry:
    """A capture, layout or picture that may become a scene.

    Attributes:
        uri: Absolute path, or fsspec URI; printable where `problem` says that it cannot be opened.
        name: Last part of the uri, printable.
        problem: Code and detail of the reason why it cannot even be opened; else None.
    """

    kind: SceneKind
    uri: str
    name: str
    problem: tuple[str, str] | None = None


@dataclass(frozen=True, slots=True)
class Discovery:
    """Entries, sorted by uri, each once, and numbers of unused files and hidden folders by kind."""

    entries: tuple[ManifestEntry, ...]
    ignored: dict[str, int]


@dataclass(frozen=True, slots=True)
class _Folder:
    uri: str
    files: tuple[str, ...]
    error: str = ""
    hidden: int = 0


def discover_entries(paths: Sequence[str]) -> Discovery:
    """Search folders for entries, and take files as they are named."""
    entries: dict[str, ManifestEntry] = {}
    ignored: Counter[str] = Counter()
    for path in paths:
        found = _walk_remote(path) if "://" in path else _walk_local(path)
        captures: set[str] = set()
        for item in found:
            for entry in [item] if isinstance(item, ManifestEntry) else _classify_folder(item, captures, ignored):
                entries.setdefault(entry.uri, _check_name(entry))
    return Discovery(tuple(sorted(entries.values(), key=lambda e: e.uri)), dict(sorted(ignored.items())))


def _walk_local(path: str) -> Iterator[_Folder | ManifestEntry]:
    if not path:
        raise InputError("an empty path: name a folder or a file; . is the folder that you are in")
    root = os.path.abspath(path)  # noqa: PTH100 Path.resolve would rename what a link names
    if os.path.isdir(root):  # noqa: PTH112 Path.is_dir raises for some hostile names
        yield from _walk_local_folders(root)
    elif os.path.isfile(root):  # noqa: PTH113
        yield _make_file_entry(root)
    else:
        raise InputError(f"{sanitize_line(path)}: no such file or folder")


def _walk_local_folders(root: str) -> Iterator[_Folder]:
    """Walk real folders in order, then those behind links; no folder is entered twice."""
    pending: list[str] = [root]
    linked: list[str] = []
    seen = set()
    while pending or linked:
        folder = pending.pop() if pending else linked.pop(0)
        try:
            status = Path(folder).stat()
            if (status.st_dev, status.st_ino) in seen:
                continue
            seen.add((status.st_dev, status.st_ino))
            children = sorted(os.scandir(folder), key=lambda child: child.name)
        except OSError as error:
            yield _Folder(folder, (), describe_error(error))
            continue
        below = {child.path: child for child in children if _is_folder(child)}
        hidden = {path for path, child in below.items() if child.name.startswith(".")}
        yield _Folder(folder, tuple(child.name for child in children if child.path not in below), hidden=len(hidden))
        entered = [child for path, child in below.items() if path not in hidden]
        pending += [child.path for child in reversed(entered) if not child.is_symlink()]
        linked += [child.path for child in entered if child.is_symlink()]


def _is_folder(child: os.DirEntry[str]) -> bool:
    try:
        return child.is_dir()
    except OSError:  # a link to itself: it stays with the files, and fails to open there
        return False


def _walk_remote(uri: str) -> Iterator[_Folder | ManifestEntry]:
    if uri.partition("://")[0] in ("s3", "s3a"):
        if ":" in uri.split("/")[2]:  # a secret with a slash in it, which would pass for a strange bucket and be shown
            raise InputError("give s3://bucket/prefix alone: credentials belong into the AWS_* variables")
        parse_path(uri)  # or a key in the address would be used, and stand in the manifest
    try:
        filesystem, root = resolve_filesystem(uri)
        found = find_type(filesystem, root)
        if found == "file":
            yield _make_file_entry(uri)
        elif found != "directory":
            raise InputError(f"{redact_uri(uri)}: no such file or folder")
        else:
            yield from _walk_remote_folders(filesystem, root)
    except (OSError, ValueError, ImportError) as error:
        # The error may repeat what is not shown.
        reason = sanitize_line(str(error)) if redact_uri(uri) == uri else type(error).__name__
        raise InputError(f"{redact_uri(uri)} cannot be reached: {reason}") from None


def _walk_remote_folders(filesystem: fsspec.AbstractFileSystem, root: str) -> Iterator[_Folder]:
    """Walk folders in order; `walk` of fsspec would leave out those that cannot be listed."""
    pending = [root]
    while pending:
        folder = pending.pop()
        entries = {entry["name"].rstrip("/"): entry["type"] for entry in filesystem.ls(folder, detail=True)}
        below = [path for path in sorted(entries) if path != folder.rstrip("/")]
        files = (posixpath.basename(path) for path in below if entries[path] != "directory")
        yield _Folder(filesystem.unstrip_protocol(folder), tuple(files))
        pending += [path for path in reversed(below) if entries[path] == "directory"]


def _make_file_entry(uri: str) -> ManifestEntry:
    suffix = posixpath.splitext(uri)[1].lower()
    if suffix not in (".json", *IMAGE_SUFFIXES, *UNREAD_SUFFIXES):
        known = ", ".join((".json", *IMAGE_SUFFIXES))
        raise InputError(
            f"{sanitize_line(uri)}: neither a picture nor a layout by its ending; give a folder or one of {known}"
        )
    return _make_entry(SceneKind.LAYOUT if suffix == ".json" else SceneKind.IMAGE, uri)


def _classify_folder(folder: _Folder, captures: set[str], ignored: Counter[str]) -> Iterator[ManifestEntry]:
    """Yield the entries of one folder; what lies in or below a capture belongs to the capture."""
    if folder.error:
        yield _make_entry(SceneKind.CAPTURE, folder.uri, ("unreadable_folder", sanitize_line(folder.error, 500)))
        return
    files = set(folder.files)
    if sum([any(name in files for name in COLOR_NAMES), DEPTH_NAME in files, CAMERA_NAME in files]) >= 2:
        captures.add(folder.uri)
        yield _make_entry(SceneKind.CAPTURE, folder.uri)
        return
    above = folder.uri
    while above not in captures and posixpath.dirname(above) != above:
        above = posixpath.dirname(above)
    if above in captures:
        return
    if folder.hidden:
        ignored["hidden folder"] += folder.hidden
    named = any(part.lower() in ASSET_FOLDERS for part in folder.uri.split("/")[-2:])
    in_assets = named or any(name.lower().endswith((*MESH_SUFFIXES, ".mtl")) for name in folder.files)
    parts = map(posixpath.splitext, folder.files)
    pictures = [stem for stem, suffix in parts if suffix.lower() in IMAGE_SUFFIXES]
    recorded = {stem + suffix for stem in pictures for suffix in (DEPTH_SUFFIX, CAMERA_SUFFIX)}
    kinds = {name: RECORDED if name in recorded else _classify_file(folder.uri, name, in_assets) for name in files}
    used = _find_used_sources([name for name, kind in kinds.items() if isinstance(kind, SceneKind)], files)
    for name in folder.files:
        kind = kinds[name]
        if isinstance(kind, SceneKind):
            yield _make_entry(kind, posixpath.join(folder.uri, name))
        elif name not in used:
            ignored[kind] += 1


def _classify_file(folder: str, name: str, in_assets: bool) -> SceneKind | str:
    suffix = posixpath.splitext(name)[1].lower()
    if name.startswith("."):
        return "hidden file"
    if is_source_file(name):
        return "source.json"
    if suffix in (*IMAGE_SUFFIXES, *UNREAD_SUFFIXES):
        return "picture among meshes" if in_assets else SceneKind.IMAGE
    if suffix == ".json":
        sidecar = name in (CAMERA_NAME, DETECTIONS_NAME, GROUND_TRUTH_NAME)
        layout = not sidecar and _looks_like_layout(posixpath.join(folder, name))
        return SceneKind.LAYOUT if layout else "JSON that is no layout"
    return "mesh" if suffix in (*MESH_SUFFIXES, ".mtl") else "other file"


def name_source_files(name: str) -> tuple[str, str]:
    """Name the files that may state source and licence of a file beside them: its own, else that of the folder."""
    return f"{posixpath.splitext(name)[0]}.source.json", "source.json"


def _find_used_sources(entries: Sequence[str], files: set[str]) -> set[str]:
    """Find the first of its source files of each entry that is there."""
    named = (next((source for source in name_source_files(name) if source in files), "") for name in entries)
    return set(named)


def is_source_file(name: str) -> bool:
    """Check whether a file states source and licence of others, and is no entry itself."""
    return name == "source.json" or name.endswith(".source.json")


def _looks_like_layout(uri: str) -> bool:
    """Check whether a file has keys of a layout, or is broken JSON: a broken layout becomes a row that says so."""
    try:
        filesystem, path = resolve_filesystem(uri) if "://" in uri else (LocalFileSystem(), uri)
        if find_type(filesystem, path) != "file":
            return False
        with filesystem.open(path, "rb") as file:
            data: bytes = file.read(MAX_JSON_BYTES + 1)
    except StoreError:
        raise
    except (OSError, ValueError):
        return True  # what cannot be read becomes a row that says so
    encoding = json.detect_encoding(data)  # in UTF-16 or UTF-32, no key would be found by its letters
    text = data if encoding.startswith("utf-8") else data.decode(encoding, "replace").encode("utf-8", "replace")
    keys = set(_LAYOUT_KEY.findall(text))
    if len(keys) > 1 and keys & {b"objects", b"mesh"}:  # one of them may be written wrong
        return True
    if len(data) > MAX_JSON_BYTES:  # too long for a layout
        return False
    try:
        value = parse_json(text, "", "bad_layout")
    except InputError:
        return True
    # Of a method that found nothing.
    return isinstance(value, dict) and value.get("objects") == [] and value.keys() <= Layout.model_fields.keys()


def _make_entry(kind: SceneKind, uri: str, problem: tuple[str, str] | None = None) -> ManifestEntry:
    return ManifestEntry(kind, uri, sanitize_line(posixpath.basename(uri.rstrip("/")), MAX_NAME_CHARS), problem)


def _check_name(entry: ManifestEntry) -> ManifestEntry:
    """Add a problem to an entry of a format that is not read, or whose name would not survive, or open another."""
    if any("\ud800" <= c <= "\udfff" for c in entry.uri):
        problem = ("name_not_utf8", "the file name is not UTF-8: rename it")
    elif len(entry.uri) > MAX_URI_CHARS:
        problem = ("name_too_long", f"{len(entry.uri)} characters; at most {MAX_URI_CHARS}: shorten the path")
    elif entry.uri.startswith("/") and "::" in entry.uri:
        problem = ("unsafe_name", "'::' in a path means another place to fsspec: rename it")
    elif entry.kind is SceneKind.IMAGE and entry.uri.lower().endswith(UNREAD_SUFFIXES):
        problem = ("unsupported_format", f"{entry.name}: pictures of this format are not read: give PNG, JPEG or WebP")
    else:
        return entry
    return replace(entry, uri=sanitize_line(entry.uri, MAX_URI_CHARS), problem=entry.problem or problem)
