"""Randomized appearance of an exported scene: table texture, lamps and camera, in memory."""

import hashlib
import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from schemas.geometry import Picture
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.png import encode_png
from tableverse_factory.core.storage.untrusted import parse_json
from tableverse_factory.physics.render.domain_randomization import randomize_appearance
from tableverse_factory.sources.textures.catalogue import TILE_M, make_texture, name_texture, parse_texture_seed

TableTexture = int | str | Picture  # A seed, a name such as `marble-12`, or a picture of shape (h, w, 3), sRGB

TEXTURE_PX = 512
MAX_PICTURE_PX = 8192


def randomize_files(
    files: Mapping[str, bytes], table_texture: TableTexture | None, lights: int | None, camera: int | None
) -> dict[str, bytes]:
    """Randomize the appearance of a scene's files; `meta.json` gets their new digests and the values asked for.

    None leaves the texture, the lights or the camera; the two latter are seeds.
    """
    lights, camera = _check_seed("lights", lights), _check_seed("camera", camera)
    table = None if table_texture is None else make_table_png(table_texture)
    changed = randomize_appearance(files, table_png=table, tile_m=TILE_M, lights=lights, camera=camera)
    if "meta.json" in files:
        style = {"texture": _describe_texture(table_texture), "lights": lights, "camera": camera}
        changed["meta.json"] = _update_meta(files, changed, style)
    return changed


def _check_seed(name: str, seed: int | None) -> int | None:
    """Return a seed as a plain int: loops over NumPy arrays give NumPy's."""
    if seed is None:
        return None
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
        raise InputError(f"{name} {seed!r:.60}: give a whole number from 0 on")
    return int(seed)


def make_table_png(table_texture: TableTexture) -> bytes:
    """Encode the texture as a PNG file."""
    picture = table_texture
    if not isinstance(picture, np.ndarray):
        picture = make_texture(parse_texture_seed(picture), TEXTURE_PX)
    if picture.ndim != 3 or picture.shape[2] != 3 or picture.dtype != np.uint8 or not picture.size:
        raise InputError(f"a texture of shape {picture.shape} and type {picture.dtype}: give (h, w, 3) in uint8")
    if max(picture.shape) > MAX_PICTURE_PX:
        raise InputError(f"a texture of {picture.shape[1]} x {picture.shape[0]} px: at most {MAX_PICTURE_PX} a side")
    return encode_png(picture)


def _describe_texture(table_texture: TableTexture | None) -> str | None:
    if table_texture is None:
        return None
    return "picture" if isinstance(table_texture, np.ndarray) else name_texture(parse_texture_seed(table_texture))


def _update_meta(files: Mapping[str, bytes], changed: Mapping[str, bytes], style: dict[str, Any]) -> bytes:
    """Update the digests of changed files in `meta.json`, so that `verify` accepts the rest as exported."""
    data = files["meta.json"]
    meta = parse_json(data, "meta.json", "bad_meta")
    if not isinstance(meta, dict) or not isinstance(meta.get("files"), dict):
        return data
    for name in changed:
        if name != "meta.json" and changed[name] != files.get(name):
            digest = hashlib.sha256(changed[name]).hexdigest()
            meta["files"][name] = {"bytes": len(changed[name]), "sha256": digest}
    return json.dumps({**meta, "style": style}, sort_keys=True, indent=1, ensure_ascii=False).encode()
