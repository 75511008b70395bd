"""A layout file: meshes and poses, somebody else's reconstruction or ours (docs/formats.md)."""

from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from schemas.identity import SafeId, clean_label

MAX_OBJECTS = 200

Finite = Annotated[float, Field(allow_inf_nan=False, ge=-1e3, le=1e3)]


class LayoutPose(BaseModel):
    """`vertex_table = R(quaternion_wxyz) @ (scale * vertex) + position` [m]."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    position: tuple[Finite, Finite, Finite]
    quaternion_wxyz: tuple[Finite, Finite, Finite, Finite]

    @model_validator(mode="after")
    def _has_a_direction(self) -> "LayoutPose":
        if sum(q * q for q in self.quaternion_wxyz) < 1e-12:
            raise ValueError("quaternion_wxyz is zero: give a unit quaternion, real part first")
        return self


class LayoutObject(BaseModel):
    """One mesh in the layout; `mesh` is relative to the layout file and stays within the layout's parent folder."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    id: SafeId
    label: Annotated[str, Field(max_length=4000), AfterValidator(clean_label)] = "object"
    mesh: Annotated[str, Field(min_length=1, max_length=1024)]
    scale: Annotated[float, Field(gt=0.0, le=1e3, allow_inf_nan=False)] = 1.0
    pose: LayoutPose
    contained_in: SafeId | None = None
    count: Annotated[int, Field(ge=1, le=100)] = 1
    """How many of it the container holds; the others repeat its mesh."""


class Layout(BaseModel):
    """The whole file. The frame is the table frame: z up, the table plane at z = 0, metres."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    scene_id: Annotated[str, Field(max_length=512)] = ""
    frame: Annotated[str, Field(max_length=512)] = ""
    objects: Annotated[tuple[LayoutObject, ...], Field(min_length=1, max_length=MAX_OBJECTS)]

    @model_validator(mode="after")
    def _ids_are_unique_and_known(self) -> "Layout":
        ids = [o.id for o in self.objects]
        if len(set(ids)) != len(ids):
            raise ValueError(f"object ids repeat: {sorted({i for i in ids if ids.count(i) > 1})}")
        for item in self.objects:
            if item.contained_in is not None and (item.contained_in not in ids or item.contained_in == item.id):
                raise ValueError(f"{item.id}: contained_in {item.contained_in!r} is not another object of this layout")
        return self
