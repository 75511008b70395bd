"""File names of PBR maps in the conventions of the sites that publish them.

    ambientCG     Wood001_1K-JPG_Color.jpg   Wood001_1K-JPG_NormalGL.jpg   Wood001_1K-JPG_Roughness.jpg
    CC0-Textures  PavingStones036_4K_Color.jpg, and older: PavingStones036_4K_col.jpg, …_nrm, …_rgh, …_disp, …_AO
    ShareTextures wood_12_basecolor-4K.png   wood_12_ambientocclusion-4K.png   wood_12_height-4K.png

Upper and lower case, `_`, `-` and spaces mean the same everywhere.
"""

import re
from dataclasses import dataclass

MAPS: dict[str, tuple[str, ...]] = {
    "color": ("color", "colour", "col", "basecolor", "base_color", "albedo", "diffuse", "diff", "diffuseoriginal"),
    "normal_gl": ("normalgl", "normal_gl", "nor_gl", "normal_opengl", "normalopengl"),
    "normal_dx": ("normaldx", "normal_dx", "nor_dx", "normal_directx", "normaldirectx"),
    "normal": ("normal", "nrm", "nor", "norm"),
    "roughness": ("roughness", "rough", "rgh"),
    "displacement": ("displacement", "disp", "height", "bump"),
    "ambient_occlusion": ("ambientocclusion", "ambient_occlusion", "ao", "occlusion", "occ"),
    "metalness": ("metalness", "metallic", "met"),
    "opacity": ("opacity", "alpha", "mask"),
    "specular": ("specular", "spec", "reflection"),
    "emission": ("emission", "emissive"),
}
"""Kinds of maps and their names. A `normal` does not say which way its green points."""

LICENCES: dict[str, str] = {"ambientcg": "CC0-1.0", "cc0-textures": "CC0-1.0", "sharetextures": "CC0-1.0"}
"""Licence of each source's maps, at the time of writing."""

_SOURCES = {"ambientcg": "ambientcg", "cc0textures": "cc0-textures", "sharetextures": "sharetextures"}
_KINDS = {alias: kind for kind, aliases in MAPS.items() for alias in aliases}
_RESOLUTION, _FORMAT = r"(?P<{0}>\d{{1,2}}k)", r"(?:jpg|jpeg|png|webp)"
_NAME = re.compile(
    rf"(?P<asset>[^_].*?)(?:_{_RESOLUTION.format('before')}(?:_{_FORMAT})?)?"
    rf"_(?P<map>{'|'.join(sorted(_KINDS, key=len, reverse=True))})"
    rf"(?:_{_RESOLUTION.format('after')})?(?:_{_FORMAT})?"
)
_MAX_CHARS = 200


@dataclass(frozen=True, slots=True)
class MapName:
    """Parsed name of a map: its set as written, a key of `MAPS`, and a resolution as `2K`, which may be empty."""

    asset: str
    kind: str
    resolution: str


def parse_map_name(stem: str) -> MapName | None:
    """Parse the stem of a file name; None if it names no map."""
    plain = re.sub(r"[\s\-]", "_", stem).lower()
    found = _NAME.fullmatch(plain) if len(plain) <= _MAX_CHARS else None
    if found is None or len(plain) != len(stem):
        return None
    resolution = (found["before"] or found["after"] or "").upper()
    return MapName(stem[: found.end("asset")], _KINDS[found["map"]], resolution)


def parse_category(asset: str) -> str:
    """Parse the words before the first number, in lower case: `wood floor` of `WoodFloor012`; may be empty."""
    words = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", re.split(r"\d", asset, maxsplit=1)[0])
    return " ".join(re.split(r"[\s_\-]+", words.strip(" _-"))).lower()


def find_source(folder: str) -> str:
    """Find the source that a folder is named after; empty if the name adds anything, as `ambientCG_edited` does."""
    return _SOURCES.get(re.sub(r"[\s_\-]", "", folder.lower()), "")
