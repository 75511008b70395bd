"""Recipe of a cousin: which changes of its parent scene were planned for it, and what may take its things' places."""

from enum import StrEnum
from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from schemas.identity import SafeId

MAX_DONORS = 9


class Change(StrEnum):
    """Kind of change, in the order in which they are made."""

    REMOVE = "remove"
    SWAP = "swap"
    SCALE = "scale"
    MOVE = "move"
    TURN = "turn"
    MIRROR = "mirror"


class Donor(BaseModel):
    """Object of the parent's dataset that may replace one of the parent: of its kind, and about as large."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    replaces: SafeId
    scene_id: SafeId
    object_id: SafeId
    digest: Annotated[str, Field(pattern=r"^[0-9a-f]{12}$")]
    """Of what the tables say of it (`dataset.cousin_rows.digest_objects`)."""


class Recipe(BaseModel):
    """Changes that are planned for a cousin; what becomes of them depends on the room in its parent."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    changes: Annotated[tuple[Change, ...], Field(min_length=1, max_length=len(Change))]
    donors: Annotated[tuple[Donor, ...], Field(max_length=MAX_DONORS)] = ()


def parse_recipe(text: str) -> Recipe:
    """Parse the JSON of a recipe; ValueError if it is none."""
    try:
        return Recipe.model_validate_json(text)
    except ValidationError as error:
        raise ValueError(f"no recipe of a cousin: {error.errors()[0]['msg']}"[:300]) from error


def _check_recipe(text: str) -> str:
    if text:
        parse_recipe(text)
    return text


RecipeText = Annotated[str, Field(max_length=4096), AfterValidator(_check_recipe)]
"""A recipe as JSON, or empty."""
