"""Index of a folder of PBR maps: a row per set with maps, category, source and licence, or why it is unusable."""

import os
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import pyarrow as pa

from schemas.identity import content_hash
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.storage.untrusted import (
    LARGE_IMAGE_BOUNDS,
    decode_image,
    open_image,
    parse_json,
    read_bytes,
)
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.sources.textures.conventions import (
    LICENCES,
    MAPS,
    MapName,
    find_source,
    parse_category,
    parse_map_name,
)

INDEX_SCHEMA = pa.schema(
    [
        ("texture_id", pa.string()),
        ("name", pa.string()),
        ("category", pa.string()),
        ("source", pa.string()),
        ("licence", pa.string()),
        ("resolution", pa.string()),  # as the name says it: 2K
        ("width", pa.int32()),  # of the colour map [px]
        ("height", pa.int32()),
        ("mean_rgb", pa.list_(pa.float64())),
        *((kind, pa.string()) for kind in MAPS),  # paths below the root
        ("rejected", pa.string()),
        ("rejected_detail", pa.string()),
    ]
)

SUFFIXES = (".jpg", ".jpeg", ".png", ".webp")
SIDECAR = "source.json"
MAX_DEPTH = 8
MAX_FILES = 500_000
MAX_TEXT_CHARS = 200
_MIN_SIDE_PX = 64


@dataclass(frozen=True, slots=True)
class _TextureSet:
    folder: str
    asset: str
    resolution: str
    maps: Mapping[str, str]
    doubled: tuple[str, ...]


def index_textures(root: Path, source: str = "") -> pa.Table:
    """Search a repository for sets of maps, read each set's colour map, and return rows of `INDEX_SCHEMA`.

    Links are not followed. The licence is that of the nearest `source.json` ({"source", "licence"}) at or above the
    set, else that of the source named here or by a folder; nothing else is taken for a licence.
    """
    if not root.is_dir():
        raise InputError(f"{sanitize_line(str(root))}: no such folder")
    files = sorted(_list_files(root))
    sidecars = {str(PurePosixPath(f).parent): f for f in files if PurePosixPath(f).name == SIDECAR}
    rows = [_make_row(root, found, _find_origin(root, found.folder, sidecars, source)) for found in _group_sets(files)]
    table = pa.Table.from_pylist(rows, INDEX_SCHEMA)
    return table.replace_schema_metadata({"root": str(root.absolute())})


def _list_files(root: Path) -> Iterator[str]:
    """Yield regular files below the root as relative paths with `/`; hidden ones, links and odd names are ignored."""
    count = 0
    for folder, names, files in os.walk(root, followlinks=False):
        here = Path(folder)
        depth = len(here.relative_to(root).parts)
        names[:] = sorted(n for n in names if not n.startswith(".") and depth < MAX_DEPTH)
        for name in files:
            path = here / name
            if not name.startswith(".") and not path.is_symlink() and path.is_file():
                relative = path.relative_to(root).as_posix()
                if relative.isprintable():
                    count += 1
                    yield relative
        if count > MAX_FILES:
            raise InputError(f"{sanitize_line(str(root))}: more than {MAX_FILES} files; index its folders one by one")


def _group_sets(files: list[str]) -> list[_TextureSet]:
    found: dict[tuple[str, str, str], dict[str, list[tuple[MapName, str]]]] = defaultdict(lambda: defaultdict(list))
    for file in files:
        path = PurePosixPath(file)
        name = parse_map_name(path.stem) if path.suffix.lower() in SUFFIXES else None
        if name is not None:
            found[str(path.parent), name.asset.lower(), name.resolution][name.kind].append((name, file))
    sets = []
    for (folder, _, resolution), kinds in sorted(found.items()):
        maps = {kind: entries[0][1] for kind, entries in kinds.items()}
        doubled = tuple(kind for kind in MAPS if len(kinds.get(kind, ())) > 1)
        asset = next(iter(kinds.values()))[0][0].asset
        sets.append(_TextureSet(folder, asset, resolution, maps, doubled))
    return sets


def _find_origin(root: Path, folder: str, sidecars: Mapping[str, str], source: str) -> tuple[str, str]:
    """Find source and licence of a folder's files; empty where none are stated."""
    path = PurePosixPath(folder)
    for place in (path, *path.parents):
        if str(place) in sidecars:
            return _read_sidecar(root, sidecars[str(place)])
    named = source or next((s for part in reversed(path.parts) if (s := find_source(part))), "")
    named = named or find_source(root.absolute().name)
    return named, LICENCES.get(named, "")


def _read_sidecar(root: Path, file: str) -> tuple[str, str]:
    """Read a sidecar; a broken one states nothing."""
    try:
        data = parse_json(read_bytes(str(root / file), 65_536, "bad_sidecar"), file, "bad_sidecar")
    except InputError:
        return "", ""
    fields = data if isinstance(data, dict) else {}
    source, licence = (fields.get(key) for key in ("source", "licence"))
    return tuple(sanitize_line(t, MAX_TEXT_CHARS) if isinstance(t, str) else "" for t in (source, licence))  # type: ignore[return-value]


def _make_row(root: Path, found: _TextureSet, origin: tuple[str, str]) -> dict[str, Any]:
    source, licence = origin
    row: dict[str, Any] = {
        "name": sanitize_line(found.asset, MAX_TEXT_CHARS),
        "category": parse_category(found.asset),
        "source": source or None,
        "licence": licence or None,
        "resolution": found.resolution or None,
        **{kind: found.maps.get(kind) for kind in MAPS},
    }
    row["texture_id"] = content_hash(f"{found.folder}/{found.asset.lower()}/{found.resolution}".encode())[:16]
    try:
        return row | _measure_maps(root, found)
    except InputError as error:
        return row | {"rejected": error.reason, "rejected_detail": sanitize_line(str(error), 500)}


def _measure_maps(root: Path, found: _TextureSet) -> dict[str, Any]:
    """Measure size and mean colour of the colour map; the other maps are opened, not decoded."""
    if "color" not in found.maps:
        raise InputError(f"no colour map beside {', '.join(sorted(found.maps))}", "no_color_map")
    if found.doubled:
        raise InputError(f"more than one file each for {', '.join(found.doubled)}", "ambiguous_maps")
    sizes = {}
    for kind, file in found.maps.items():
        data = read_bytes(str(root / file), LARGE_IMAGE_BOUNDS.max_file_bytes, "unreadable_map")
        image = open_image(data, file, LARGE_IMAGE_BOUNDS, "unreadable_map")
        sizes[kind] = image.size
        if kind == "color":
            mean = decode_image(image, file, "RGB", "unreadable_map").reshape(-1, 3).mean(axis=0)
    width, height = sizes["color"]
    if min(width, height) < _MIN_SIDE_PX:
        raise InputError(f"{width} x {height} px: at least {_MIN_SIDE_PX} a side", "picture_too_small")
    if odd := [kind for kind, (w, h) in sizes.items() if w * height != h * width]:
        raise InputError(f"{', '.join(odd)} of another shape than the colour map's", "shapes_differ")
    return {"width": width, "height": height, "mean_rgb": [round(float(c), 3) for c in mean]}
