"""Pictures inside of a GLB file: trimesh leaves out what it cannot open, without a word."""

import base64
import io
import json
import struct
from collections.abc import Iterator, Mapping
from typing import Any

from PIL import Image

from tableverse_factory.core.errors import GeometryError
from tableverse_factory.core.storage.untrusted import IMAGE_FORMATS

_CHUNKS_AT, _HEADER_BYTES = 12, 8  # of the file and of a chunk: glTF 2.0, "Binary glTF layout"
_WEBP, _GLOSSY = "EXT_texture_webp", "KHR_materials_pbrSpecularGlossiness"


def check_glb_pictures(data: bytes) -> None:
    """Check that Pillow can open every base colour picture that a GLB shows; whatever is wrong raises an error."""
    (length,) = struct.unpack_from("<I", data, _CHUNKS_AT)
    start = _CHUNKS_AT + _HEADER_BYTES
    document = json.loads(data[start : start + length])
    binary = data[start + length + _HEADER_BYTES :]
    for number in sorted({*_list_shown_pictures(document)}):
        with Image.open(io.BytesIO(_read_picture(document, number, binary))) as picture:
            if picture.format not in IMAGE_FORMATS:
                raise GeometryError(f"picture {number} is {picture.format}; give one of {', '.join(IMAGE_FORMATS)}")


def _list_shown_pictures(document: Mapping[str, Any]) -> Iterator[int]:
    primitives = [part for mesh in document.get("meshes") or () for part in mesh.get("primitives") or ()]
    for number in {part["material"] for part in primitives if part.get("material") is not None}:
        material = document["materials"][number]
        glossy = (material.get("extensions") or {}).get(_GLOSSY) or {}
        place = (material.get("pbrMetallicRoughness") or {}).get("baseColorTexture") or glossy.get("diffuseTexture")
        if place is None:
            continue
        texture = document["textures"][place["index"]]
        source = ((texture.get("extensions") or {}).get(_WEBP) or texture).get("source")
        if source is None:
            raise GeometryError(f"texture {place['index']} has no picture of a known format: embed PNG or JPEG")
        yield int(source)


def _read_picture(document: Mapping[str, Any], number: int, binary: bytes) -> bytes:
    picture = document["images"][number]
    if "bufferView" in picture:
        view = document["bufferViews"][picture["bufferView"]]
        if view.get("buffer", 0) != 0:
            raise GeometryError(f"picture {number} lies in buffer {view['buffer']}: a GLB has its own, 0")
        start = int(view.get("byteOffset", 0))
        return binary[start : start + int(view["byteLength"])]
    head, _, text = str(picture.get("uri", "")).partition(",")
    if not head.startswith("data:"):
        raise GeometryError(f"picture {number} lies in another file: embed it")
    return base64.b64decode(text)
