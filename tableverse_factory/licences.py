"""What a licence allows to be done with a scene that was made from a picture, by its name alone.

A scene is an adaptation of its picture: textures come from the pixels, shapes from what they show. Verdicts sort; they
are no legal advice. What is not recognised is `unknown`, and nothing that is unknown counts as permitted.
"""

import re
from collections.abc import Mapping
from enum import StrEnum


class Verdict(StrEnum):
    """What may be done with a scene, from the least to the most restricted."""

    PERMISSIVE = "permissive"
    """May be adapted and passed on, at most with credit."""
    SHARE_ALIKE = "share-alike"
    """The same, but only under the same licence."""
    NON_COMMERCIAL = "non-commercial"
    """Not for commercial use."""
    NO_DERIVATIVES = "no-derivatives"
    """May be passed on, but not adapted; a scene is an adaptation."""
    RESTRICTED = "restricted"
    """All rights are reserved."""
    UNKNOWN = "unknown"
    """No licence is stated, or none that is recognised."""


PROFILES: Mapping[str, frozenset[Verdict]] = {
    "permissive": frozenset({Verdict.PERMISSIVE}),
    "share-alike": frozenset({Verdict.PERMISSIVE, Verdict.SHARE_ALIKE}),
    "non-commercial": frozenset({Verdict.PERMISSIVE, Verdict.SHARE_ALIKE, Verdict.NON_COMMERCIAL}),
}
"""Which verdicts a published dataset may hold."""

_PERMISSIVE = re.compile(
    r"cc0([- ]1\.0)?|cc[- ]?zero|pdm|pddl(-1\.0)?|public[- ]domain( mark| dedication)?( 1\.0)?|unlicense|0bsd|wtfpl"
    r"|mit(-0)?|isc|zlib|bsd(-[1-4]-clause)?|apache([- ]2\.0)?|bsl-1\.0|upl-1\.0|ncsa|odc-by(-1\.0)?"
    r"|cdla-permissive-[12]\.0|ogl-uk-[123]\.0|unsplash( license)?|pexels( license)?"
)
_SHARE_ALIKE = re.compile(
    r"(a|l)?gpl(-[123](\.[01])?(-only|-or-later|\+)?)?|odbl(-1\.0)?|mpl-[12]\.[01]|epl-[12]\.0|cdla-sharing-1\.0"
    r"|gfdl(-1\.[123](-only|-or-later)?)?"
)
_RESTRICTED = re.compile(r"all rights reserved|proprietary|copyrighted|none|licenseref-proprietary")
_CREATIVE_COMMONS = re.compile(
    r"cc[- ]?by((?:[- ](?:nc|nd|sa))*)(?:[- ][1-4]\.[05](?:[- ](?!nc|nd|sa)(?:igo|[a-z]{2}))?)?"
)
_ADDRESS = re.compile(r"https?://(www\.)?creativecommons\.org/(licenses|publicdomain)/([a-z-]+)(/[0-9.]+)?(/[a-z.]*)*")
_SUFFIXES = re.compile(r"\s+(international|unported|generic|universal|licen[cs]e)\b")
_MAX_CHARS = 512


def verdict_of(licence: str | None) -> Verdict:
    """The verdict on a licence as `source.json` names it.

    SPDX identifiers, their usual spellings (`CC BY 4.0`), addresses of Creative Commons, and expressions: of `A OR B`
    the freer counts, of `A AND B` the stricter. Brackets, exceptions and free text are `unknown`.
    """
    text = " ".join((licence or "")[: _MAX_CHARS + 1].lower().split())
    if not text or len(text) > _MAX_CHARS:
        return Verdict.UNKNOWN
    order = list(Verdict)
    choices = [max(map(_single, re.split(r" and ", choice)), key=order.index) for choice in re.split(r" or ", text)]
    return min(choices, key=order.index)


def _single(name: str) -> Verdict:
    plain = _SUFFIXES.sub("", _spelled_out(name.strip().removeprefix("the ")))
    if (commons := _CREATIVE_COMMONS.fullmatch(plain)) is not None:
        return _of_terms(commons[1])
    for pattern, verdict in (
        (_PERMISSIVE, Verdict.PERMISSIVE),
        (_SHARE_ALIKE, Verdict.SHARE_ALIKE),
        (_RESTRICTED, Verdict.RESTRICTED),
    ):
        if pattern.fullmatch(plain):
            return verdict
    return Verdict.UNKNOWN


def _spelled_out(name: str) -> str:
    """An address of Creative Commons, or its long name, as the short one."""
    if (address := _ADDRESS.fullmatch(name)) is not None:
        return {"zero": "cc0", "mark": "pdm"}.get(address[3], f"cc-{address[3]}")
    for long, short in (
        ("creative commons", "cc"),
        ("attribution", "by"),
        ("noncommercial", "nc"),
        ("non-commercial", "nc"),
        ("noderivatives", "nd"),
        ("noderivs", "nd"),
        ("sharealike", "sa"),
        ("share alike", "sa"),
    ):
        name = name.replace(long, short)
    return name


def _of_terms(terms: str) -> Verdict:
    if "nd" in terms:
        return Verdict.NO_DERIVATIVES
    if "nc" in terms:
        return Verdict.NON_COMMERCIAL
    return Verdict.SHARE_ALIKE if "sa" in terms else Verdict.PERMISSIVE
