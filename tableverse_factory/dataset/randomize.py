"""Randomised looks of an exported scene: a texture on its table, other lamps, another camera, all in memory."""

import hashlib
import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from schemas.geometry import Picture
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.png import encode_png
from tableverse_factory.physics.render.domain_randomization import randomize_appearance
from tableverse_factory.sources.textures.catalogue import TILE_M, make_texture, name_texture, parse_texture_seed

TableTexture = int | str | Picture
"""A seed, a name as `marble-12`, or a picture of shape (h, w, 3), sRGB."""

TEXTURE_PX = 512
MAX_PICTURE_PX = 8192


def randomize_files(
    files: Mapping[str, bytes], look: TableTexture | None, lights: int | None, camera: int | None
) -> dict[str, bytes]:
    """The scene's files with another look; `meta.json` keeps the digests of what is there now and says what was asked.

    Args:
        files: Of an exported scene.
        look: What lies on the table; None leaves it.
        lights: Seed, or None.
        camera: Seed, or None.

    Raises:
        InputError: if the texture or a seed is none, or the scene cannot be changed.
    """
    lights, camera = _seed("lights", lights), _seed("camera", camera)
    table = None if look is None else make_table_png(look)
    staged = randomize_appearance(files, table_png=table, tile_m=TILE_M, lights=lights, camera=camera)
    if "meta.json" in files:
        style = {"texture": _name(look), "lights": lights, "camera": camera}
        staged["meta.json"] = _with_style(files, staged, style)
    return staged


def _seed(name: str, seed: int | None) -> int | None:
    """A seed as a plain number: loops over NumPy arrays give theirs."""
    if seed is None:
        return None
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
        raise InputError(f"{name} {seed!r:.60}: give a whole number from 0 on")
    return int(seed)


def make_table_png(look: TableTexture) -> bytes:
    """The texture as a PNG file.

    Raises:
        InputError: if there is no such texture, or the picture is none.
    """
    picture = look if isinstance(look, np.ndarray) else make_texture(parse_texture_seed(look), TEXTURE_PX)
    if picture.ndim != 3 or picture.shape[2] != 3 or picture.dtype != np.uint8 or not picture.size:
        raise InputError(f"a texture of shape {picture.shape} and type {picture.dtype}: give (h, w, 3) in uint8")
    if max(picture.shape) > MAX_PICTURE_PX:
        raise InputError(f"a texture of {picture.shape[1]} x {picture.shape[0]} px: at most {MAX_PICTURE_PX} a side")
    return encode_png(picture)


def _name(look: TableTexture | None) -> str | None:
    if look is None:
        return None
    return "picture" if isinstance(look, np.ndarray) else name_texture(parse_texture_seed(look))


def _with_style(files: Mapping[str, bytes], staged: Mapping[str, bytes], style: dict[str, Any]) -> bytes:
    """`meta.json` with new digests of the files that changed, so that `verify` knows the rest for the exported ones."""
    data = files["meta.json"]
    try:
        meta = json.loads(data)
    except ValueError as error:
        raise InputError(f"meta.json does not parse: {error}"[:300], "bad_meta") from None
    if not isinstance(meta, dict) or not isinstance(meta.get("files"), dict):
        return data
    for name in staged:
        if name != "meta.json" and staged[name] != files.get(name):
            digest = hashlib.sha256(staged[name]).hexdigest()
            meta["files"][name] = {"bytes": len(staged[name]), "sha256": digest}
    return json.dumps({**meta, "style": style}, sort_keys=True, indent=1, ensure_ascii=False).encode()
