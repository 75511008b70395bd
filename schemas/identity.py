"""Ids of scenes and objects: short, safe as a file name, and derived from content if we choose them."""

import hashlib
import re
from collections.abc import Sequence
from typing import Annotated

from pydantic import AfterValidator

MAX_LABEL_CHARS = 120
MAX_STEM_CHARS = 80
UNNAMED = "object"  # label of what nobody has named
RESERVED_IDS = ("backdrop", "scene", "sky", "table", "world")  # names of a scene's own parts, which no object can have

SAFE_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.\-]{0,79}")


def check_id(value: str) -> str:
    """Return `value` if it is safe as an id, a file name and an XML name; else raise ValueError."""
    if not SAFE_ID.fullmatch(value) or ".." in value:
        raise ValueError(
            f"id {value[:100]!r} is not usable: give 1 to 80 letters, digits, '_', '-' or single '.', "
            "starting with a letter or digit"
        )
    return value


SafeId = Annotated[str, AfterValidator(check_id)]


def make_object_id(index: int) -> str:
    """Make the id of the object at `index` of its scene: `obj_000`, `obj_001` and so on."""
    return f"obj_{index:03d}"


def clean_label(text: str) -> str:
    """Clean an untrusted label to one line of at most 120 printable characters; `object` if nothing is left."""
    printable = "".join(c if c.isprintable() else " " for c in text)
    return " ".join(printable.split())[:MAX_LABEL_CHARS].strip() or UNNAMED


def content_hash(*parts: bytes) -> str:
    """Hash length-prefixed parts with SHA-256, so that moving a byte between parts changes the hash."""
    digest = hashlib.sha256()
    for part in parts:
        digest.update(len(part).to_bytes(8, "little"))
        digest.update(part)
    return digest.hexdigest()


def make_file_stem(object_id: str) -> str:
    """Make the stem of an object's files: its id, shortened and made unique by a hash if a tar could not hold it."""
    if len(object_id) <= MAX_STEM_CHARS:
        return object_id
    return f"{object_id[: MAX_STEM_CHARS - 17]}-{content_hash(object_id.encode())[:16]}"


def find_name_clashes(object_ids: Sequence[str]) -> list[str]:
    """Find object ids that cannot be in one scene: reserved ones, and those whose files would clash."""
    seen: dict[str, str] = {}
    bad = [i for i in object_ids if i.lower() in RESERVED_IDS]
    for object_id in object_ids:
        stem = make_file_stem(object_id).lower().split("_piece_")[0]
        if seen.setdefault(stem, object_id) != object_id:
            bad.append(object_id)
    return bad
