"""Row of the image manifest: the location of an input, and whether it can enter the pipeline."""

from enum import StrEnum
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from schemas.cousins import RecipeText
from schemas.identity import SAFE_ID, SafeId
from schemas.known_length import KnownLengthText

REQUIRED_COLUMNS = ("scene_id", "kind", "uri")  # of a manifest; other columns may be missing


class SceneKind(StrEnum):
    """Kind of input that a manifest row points at (see docs/formats.md)."""

    IMAGE = "image"
    CAPTURE = "capture"
    LAYOUT = "layout"
    COUSIN = "cousin"


ParentId = Annotated[str, Field(pattern=rf"^({SAFE_ID.pattern})?$")]


class ImageRow(BaseModel):
    """Entry of the manifest.

    Attributes:
        scene_id: Derived from the content; safe as a file name.
        uri: Folder of a capture, file of a picture or layout, dataset of a cousin's parent; a path or an fsspec URI.
        name: The entry's own name, for people; untrusted text.
        content_sha256: Hash of the bytes that the row was made from; empty if they could not be read.
        url: Address that the picture was fetched from, without user, query and fragment; empty for a local file.
        known_length: A length that is known in the picture, as JSON (`schemas.known_length`); else empty.
        parent: Scene that a cousin is derived from, in the dataset `uri`; else empty.
        family: Scene that its parent, or the parent's own, was derived from in the end; empty for all but cousins.
        recipe: Changes that are planned for a cousin, as JSON (`schemas.cousins`); else empty.
        rejected: Empty, or the code of the reason why the entry cannot enter (`unreadable_color`, …).
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    scene_id: SafeId
    kind: SceneKind
    uri: Annotated[str, Field(max_length=4096)]
    name: Annotated[str, Field(max_length=512)] = ""
    content_sha256: Annotated[str, Field(pattern=r"^([0-9a-f]{64})?$")] = ""
    url: Annotated[str, Field(max_length=4096)] = ""
    source: Annotated[str, Field(max_length=2048)] = ""
    licence: Annotated[str, Field(max_length=512)] = ""
    known_length: KnownLengthText = ""
    parent: ParentId = ""
    family: ParentId = ""
    recipe: RecipeText = ""
    rejected: Annotated[str, Field(max_length=80, pattern=r"^[a-z0-9_]*$")] = ""
    rejected_detail: Annotated[str, Field(max_length=2000)] = ""
