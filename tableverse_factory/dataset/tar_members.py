"""Files of one scene from its untrusted bytes of a tar."""

import io
import tarfile
from collections.abc import Sequence
from pathlib import PurePosixPath

from tableverse_factory.core.errors import InputError
from tableverse_factory.core.text import sanitize_line


def read_scene_files(scene_id: str, data: bytes) -> dict[str, bytes]:
    """Read the plain files of a slice of a tar, with names relative to the scene's folder and checked to stay in it."""
    files: dict[str, bytes] = {}
    try:
        with tarfile.open(fileobj=io.BytesIO(data), mode="r:") as tar:
            for member in tar:
                name, stream = _check_name(scene_id, member), tar.extractfile(member)
                files[name] = stream.read() if stream is not None else b""
                if len(files[name]) != member.size:
                    raise ValueError(f"{member.name} is cut short")
    except (tarfile.TarError, EOFError, ValueError) as error:
        raise InputError(f"scene {scene_id}: its bytes are no tar: {sanitize_line(str(error), 200)}") from None
    return files


def _check_name(scene_id: str, member: tarfile.TarInfo) -> str:
    path = PurePosixPath(member.name)
    inside: Sequence[str] = path.parts[1:]
    safe = path.parts[:1] == (scene_id,) and inside and ".." not in inside and "\\" not in member.name
    if not safe or not member.isreg() or member.issparse() or not member.name.isprintable():
        raise InputError(f"scene {scene_id}: member {sanitize_line(member.name, 100)!r} is no plain file of this scene")
    return "/".join(inside)
