"""Content hash of a manifest entry: over every byte that decoding reads."""

from functools import partial

from schemas.config import ObserveConfig
from schemas.identity import content_hash
from schemas.manifest import ImageRow, SceneKind
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.storage.untrusted import MAX_JSON_BYTES, exists, read_bytes
from tableverse_factory.sources.capture import (
    CAMERA_NAME,
    COLOR_NAMES,
    DEPTH_NAME,
    DETECTIONS_NAME,
    MASKS_NAME,
    MESHES_NAME,
    list_recorded_meshes,
)
from tableverse_factory.sources.layout_file import read_layout_file, resolve_mesh_uri
from tableverse_factory.sources.mesh_file import read_material_files

DEPTH_SUFFIX, CAMERA_SUFFIX = ".depth.npy", ".camera.json"
"""Suffixes of the depth and the camera recorded beside a picture `NAME.jpg`."""

_CAPTURE_FILES = (*COLOR_NAMES, DEPTH_NAME, CAMERA_NAME, DETECTIONS_NAME, MASKS_NAME)


def hash_entry(kind: SceneKind, uri: str, bounds: ObserveConfig, known: dict[str, str] | None = None) -> str:
    """Hash the files of an entry (sha256); `known` collects digests of meshes by uri, which layouts share."""
    if kind is SceneKind.IMAGE:
        return _hash_image(uri, bounds)
    if kind is SceneKind.CAPTURE:
        return _hash_capture(uri, bounds)
    return _hash_layout(uri, bounds, {} if known is None else known)


def verify_content_hash(row: ImageRow, bounds: ObserveConfig) -> None:
    """Compare an entry with the hash in the manifest, if there is one, else raise `content_changed`."""
    if row.content_sha256 and (found := hash_entry(row.kind, row.uri, bounds)) != row.content_sha256:
        change = f"sha256 {found[:12]}, not {row.content_sha256[:12]}"
        problem = f"read as {row.kind.value}, it is not what the manifest saw ({change}): make the manifest again"
        raise InputError(problem, "content_changed")


def find_sidecars(uri: str) -> dict[str, str]:
    """Find the depth and the camera recorded beside a picture, by suffix; none over HTTP."""
    if uri.startswith(("http://", "https://")):
        return {}
    stem = uri.rpartition(".")[0]
    return {suffix: stem + suffix for suffix in (DEPTH_SUFFIX, CAMERA_SUFFIX) if exists(stem + suffix)}


def _hash_image(uri: str, bounds: ObserveConfig) -> str:
    picture = read_bytes(uri, bounds.max_file_bytes, "unreadable_color")
    parts: list[bytes] = []
    for name, sidecar in find_sidecars(uri).items():
        parts += [name.encode(), read_bytes(sidecar, bounds.max_file_bytes, "unreadable_file")]
    return content_hash(picture, *parts)


def _hash_capture(uri: str, bounds: ObserveConfig) -> str:
    """Hash the files that exist, and the meshes that `place.mesh_model` = replay would read."""
    folder = uri.rstrip("/")
    present = [name for name in _CAPTURE_FILES if exists(f"{folder}/{name}")]
    if not any(name in COLOR_NAMES for name in present):
        raise InputError(
            f"no {' or '.join(COLOR_NAMES)} in {folder!r}: a capture is a folder with one", "missing_color"
        )
    files = (read_bytes(f"{folder}/{name}", bounds.max_file_bytes, "unreadable_file") for name in present)
    parts = [part for name, data in zip(present, files, strict=True) for part in (name.encode(), data)]
    for name in list_recorded_meshes(folder):
        data = read_bytes(f"{folder}/{MESHES_NAME}/{name}", bounds.max_file_bytes, "unreadable_file")
        parts += [f"{MESHES_NAME}/{name}".encode(), content_hash(data).encode()]
    return content_hash(*parts)


def _hash_layout(uri: str, bounds: ObserveConfig, known: dict[str, str]) -> str:
    text = read_bytes(uri, MAX_JSON_BYTES, "bad_layout")
    names = sorted({item.mesh for item in read_layout_file(uri).objects})
    meshes = {mesh: resolve_mesh_uri(uri, mesh) for mesh in names}
    for mesh, where in meshes.items():
        if where not in known:
            data = read_bytes(where, bounds.max_file_bytes, "missing_mesh")
            materials = read_material_files(mesh, data, partial(resolve_mesh_uri, uri), bounds)
            parts = (part for name in sorted(materials) for part in (name.encode(), materials[name]))
            known[where] = content_hash(data, *parts)
    return content_hash(text, *(known[where].encode() for where in meshes.values()))
