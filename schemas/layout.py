"""Layout file: meshes and poses of a scene, from another reconstruction or ours (docs/formats.md)."""

import difflib
import re
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from schemas.identity import RESERVED_IDS, SafeId, clean_label, find_name_clashes

MAX_OBJECTS = 200
FRAME = "table: z up, table plane z=0, metres"  # `table` alone means the same, and any part of it, with further notes

Finite = Annotated[float, Field(allow_inf_nan=False, ge=-1e3, le=1e3)]

_OTHER_FRAME = re.compile(
    r"""
    (?<![a-z0-9]) [+-]?[xy] [\s_=:-]* (?:axis\s*)? (?:(?:is|points)\s*)? up  # another axis is up
    | (?<!\w) -z [\s_-]* (?:axis\s*)? (?:is\s*)? up
    | (?<![a-z0-9]) z [\s_=:-]* (?:axis\s*)? (?:(?:is|points)\s*)? down
    | \bup \s* (?:is|axis|[=:])* \s* (?:[+-]?[xy]|-z) \b
    | plane \s* (?:at\s*|is\s*|:\s*)? (?:[xy]\s*= | z\s*= (?!\s*0(?:\.0*)?(?![\d.])))
    | (?<![\w.]) (?<!\d\s) (?:in\s+|units?\s*[=:]?\s*)?          # another unit, not a length such as 0.5 mm
      (?:mm|cm|dm|km|inch(?:es)?|feet|foot|ft|(?:milli|centi|deci|kilo|micro)met(?:re|er)s?) \b
    | \b(?:camera|world|robot|optical) [\s_-]* (?:frame|coordinates|axes)
    """,
    re.VERBOSE,
)


def _check_frame(text: str) -> str:
    """Return the text if it is empty, or begins with `table` and nothing in it contradicts the table frame.

    Parentheses hold notes, unless they hold nothing but a contradiction: `(y up)`.
    """
    lowered = text.strip().lower()
    notes, rest = re.findall(r"\(([^()]*)\)", lowered), re.sub(r"\([^()]*\)", ",", lowered)
    other = _OTHER_FRAME.search(rest) or any(_OTHER_FRAME.fullmatch(note.strip()) for note in notes)
    if lowered and (other or not re.match(r"table(?![a-z0-9])", lowered)):
        raise ValueError(f'poses are read in the table frame only: write "{FRAME}"')
    return text


class _StrictModel(BaseModel):
    """Base that refuses unknown keys: a typing error would otherwise leave a default in place."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    @model_validator(mode="before")
    @classmethod
    def _check_keys(cls, value: Any) -> Any:
        for key in value if isinstance(value, dict) else ():
            if key not in cls.model_fields:
                close = difflib.get_close_matches(str(key).lower(), cls.model_fields, n=1)
                advice = f"did you mean {close[0]}?" if close else f"keys are {', '.join(cls.model_fields)}"
                raise ValueError(f"unknown key {str(key)[:60]!r}; {advice}")
        return value


class LayoutPose(_StrictModel):
    """`vertex_table = R(quaternion_wxyz) @ (scale * vertex) + position` [m]."""

    position: tuple[Finite, Finite, Finite]
    quaternion_wxyz: tuple[Finite, Finite, Finite, Finite]

    @model_validator(mode="after")
    def _check_quaternion(self) -> "LayoutPose":
        if sum(q * q for q in self.quaternion_wxyz) < 1e-12:
            raise ValueError("quaternion_wxyz is zero: give a unit quaternion, real part first")
        return self


class LayoutObject(_StrictModel):
    """Mesh in the layout; `mesh` is relative to the layout file and stays within the layout's parent folder."""

    id: SafeId
    label: Annotated[str, Field(max_length=4000), AfterValidator(clean_label)] = "object"
    mesh: Annotated[str, Field(min_length=1, max_length=1024)]
    scale: Annotated[float, Field(gt=0.0, le=1e3, allow_inf_nan=False)] = 1.0
    pose: LayoutPose
    contained_in: SafeId | None = None
    count: Annotated[int, Field(ge=1, le=100)] = 1
    """Number of such objects in the container; the others repeat its mesh."""


class Layout(_StrictModel):
    """Layout file. The frame is the table frame: z up, table plane at z = 0, metres; `origin` is never read."""

    scene_id: Annotated[str, Field(max_length=512)] = ""
    frame: Annotated[str, Field(max_length=512), AfterValidator(_check_frame)] = ""
    origin: Any = None
    objects: Annotated[tuple[LayoutObject, ...], Field(min_length=1, max_length=MAX_OBJECTS)]

    @model_validator(mode="after")
    def _check_ids(self) -> "Layout":
        ids = [o.id for o in self.objects]
        if len(set(ids)) != len(ids):
            raise ValueError(f"object ids repeat: {sorted({i for i in ids if ids.count(i) > 1})}")
        if bad := find_name_clashes(ids):
            raise ValueError(
                f"object id {bad[0]!r} cannot be used: {', '.join(RESERVED_IDS)} are parts of every scene, and ids "
                "that differ only in case or in what follows _piece_ would share files; give another id"
            )
        return self

    @model_validator(mode="after")
    def _check_containment(self) -> "Layout":
        holder = {o.id: o.contained_in for o in self.objects}
        for item in self.objects:
            if item.contained_in is not None and item.contained_in not in holder:
                raise ValueError(f"{item.id}: contained_in {item.contained_in!r} is no object of this layout")
        for name in sorted(holder):
            chain, at = [name], holder[name]
            while at is not None and at not in chain:
                chain.append(at)
                at = holder[at]
            if at is not None:
                circle = [*chain[chain.index(at) :], at]
                raise ValueError(f"contained_in goes in a circle: {' in '.join(circle)[:300]}; one of them must stand")
        return self
