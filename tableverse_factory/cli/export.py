"""`tableverse export`: a dataset that may be passed on."""

from enum import StrEnum
from typing import Annotated

import typer


class Profile(StrEnum):
    """What the licences of the scenes must allow."""

    PERMISSIVE = "permissive"
    SHARE_ALIKE = "share-alike"
    NON_COMMERCIAL = "non-commercial"


def export(
    out: Annotated[str, typer.Argument(help="A finished dataset: OUT of `tableverse build`.")],
    dest: Annotated[
        str, typer.Argument(help="A new or empty folder for the dataset that is passed on, or s3://bucket/prefix.")
    ],
    profile: Annotated[
        Profile, typer.Option(help="permissive: credit at most; share-alike and non-commercial allow these terms too.")
    ] = Profile.PERMISSIVE,
) -> None:
    """Write the scenes whose licences allow it as a dataset of their own; the rest leaves no trace in it.

    Example: `tableverse export out out-public --profile permissive`
    """
    from tableverse_factory.publish import publish
    from tableverse_factory.storage import place_of
    from workers.ledger import WORK
    from workers.lock import LOCK, writer_lock

    place = place_of(dest)
    with writer_lock(place / WORK / LOCK):
        result = publish(place_of(out), place, profile.value)
    print(f"{result.kept} scenes, {result.done} of them with files, in {dest}")
    for verdict, count in sorted(result.left_out.items()):
        print(f"left out: {count} {verdict.value}")
