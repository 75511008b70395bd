"""Classification of licences by name: what may be done with a scene that was made from a picture.

A scene is an adaptation of its picture: textures come from the pixels, shapes from what they show. Verdicts sort; they
are no legal advice. What is not recognised is `unknown`, and nothing that is unknown counts as permitted.
"""

import re
from collections.abc import Mapping
from enum import StrEnum
from typing import Any


class LicenceVerdict(StrEnum):
    """Permitted use of a scene, from the least to the most restricted."""

    PERMISSIVE = "permissive"  # may be adapted and passed on, at most with credit
    SHARE_ALIKE = "share-alike"  # the same, but only under the same licence
    NON_COMMERCIAL = "non-commercial"
    NO_DERIVATIVES = "no-derivatives"  # may be passed on, but not adapted; a scene is an adaptation
    RESTRICTED = "restricted"  # all rights are reserved, or the terms forbid collections of the works
    UNKNOWN = "unknown"  # no licence is stated, or none that is recognised


# Verdicts that a published dataset may hold
PROFILES: Mapping[str, frozenset[LicenceVerdict]] = {
    "permissive": frozenset({LicenceVerdict.PERMISSIVE}),
    "share-alike": frozenset({LicenceVerdict.PERMISSIVE, LicenceVerdict.SHARE_ALIKE}),
    "non-commercial": frozenset({LicenceVerdict.PERMISSIVE, LicenceVerdict.SHARE_ALIKE, LicenceVerdict.NON_COMMERCIAL}),
}

_PERMISSIVE = re.compile(
    r"cc0([- ]1\.0)?|cc[- ]?zero|pdm|pddl(-1\.0)?|public[- ]domain( mark| dedication)?( 1\.0)?|unlicense|0bsd|wtfpl"
    r"|mit(-0)?|isc|zlib|bsd(-[1-4]-clause)?|apache([- ]2\.0)?|bsl-1\.0|upl-1\.0|ncsa|odc-by(-1\.0)?"
    r"|cdla-permissive-[12]\.0|ogl-uk-[123]\.0"
)
_SHARE_ALIKE = re.compile(
    r"(a|l)?gpl(-[123](\.[01])?(-only|-or-later|\+)?)?|odbl(-1\.0)?|mpl-[12]\.[01]|epl-[12]\.0|cdla-sharing-1\.0"
    r"|gfdl(-1\.[123](-only|-or-later)?)?"
)
# Unsplash and Pexels: single pictures are free to use, collections that compete with theirs are not.
_RESTRICTED = re.compile(r"all rights reserved|proprietary|copyrighted|none|licenseref-proprietary|unsplash|pexels")
# Where licences up to 3.0 were adapted to national law; 4.0 never was.
_JURISDICTIONS = (
    "ar at au az be bg br ca ch cl cn co cr cz de dk ec ee eg es fi fr ge gr gt hk hr hu ie igo il in it jp kr lu mk mt"
    " mx my nl no nz pe ph pl pr pt ro rs scotland se sg si th tw ug uk us ve vn za"
).replace(" ", "|")
_CREATIVE_COMMONS = re.compile(
    rf"cc[- ]?by((?:[- ](?:nc|nd|sa))*)(?:[- ](?:4\.0|[1-3]\.[05](?:[- ](?:{_JURISDICTIONS}))?))?"
)
_ADDRESS = re.compile(
    r"https?://(?:www\.)?creativecommons\.org/(?:licenses/(?P<licence>by(?:-(?:nc|nd|sa))*)|publicdomain/(?P<free>zero|mark))"
    rf"(?:/(?:4\.0|[1-3]\.[0-9](?:/(?:{_JURISDICTIONS}))?))?(?:/(?:deed|legalcode)(?:\.[a-z]{{2,3}}(?:-[a-z]{{2,4}})?)?)?/?"
)
_SHORT_TERMS = {
    "creative commons": "cc",
    "attribution": "by",
    "noncommercial": "nc",
    "non-commercial": "nc",
    "noderivatives": "nd",
    "noderivs": "nd",
    "sharealike": "sa",
    "share alike": "sa",
}
_SUFFIXES = re.compile(r"\s+(international|unported|generic|universal|licen[cs]e)\b")
_PROSE = re.compile(r"[()\[\],;]")
_MAX_CHARS = 512


def classify_license(licence: str | None) -> LicenceVerdict:
    """Classify a licence as `source.json` names it.

    SPDX identifiers, their usual spellings (`CC BY 4.0`), addresses of Creative Commons, and expressions: of `A OR B`
    the freer counts, of `A AND B` the stricter. One part that is unknown or restricted decides for the whole: it may be
    the end of a sentence that takes back what the other parts give. Brackets, exceptions and free text are `unknown`.
    """
    text = " ".join((licence or "")[: _MAX_CHARS + 1].lower().split())
    if not text or len(text) > _MAX_CHARS or _PROSE.search(text):
        return LicenceVerdict.UNKNOWN
    choices = [[_classify_name(name) for name in choice.split(" and ")] for choice in text.split(" or ")]
    for verdict in (LicenceVerdict.UNKNOWN, LicenceVerdict.RESTRICTED):
        if any(verdict in names for names in choices):
            return verdict
    order = list(LicenceVerdict).index
    return min((max(names, key=order) for names in choices), key=order)


def scene_license(row: Mapping[str, Any]) -> LicenceVerdict:
    """Classify a scene by its row: the most restricted of its picture's licence and those of generated meshes."""
    return max(map(classify_license, (row["licence"], *(row["mesh_licences"] or ()))), key=list(LicenceVerdict).index)


def _classify_name(name: str) -> LicenceVerdict:
    plain = _SUFFIXES.sub("", _shorten_name(name.strip().removeprefix("the ")))
    if (commons := _CREATIVE_COMMONS.fullmatch(plain)) is not None:
        return _classify_terms(commons[1])
    for pattern, verdict in (
        (_PERMISSIVE, LicenceVerdict.PERMISSIVE),
        (_SHARE_ALIKE, LicenceVerdict.SHARE_ALIKE),
        (_RESTRICTED, LicenceVerdict.RESTRICTED),
    ):
        if pattern.fullmatch(plain):
            return verdict
    return LicenceVerdict.UNKNOWN


def _shorten_name(name: str) -> str:
    """Shorten an address of Creative Commons, or its long name."""
    if (address := _ADDRESS.fullmatch(name)) is not None:
        return {"zero": "cc0", "mark": "pdm"}[address["free"]] if address["free"] else f"cc-{address['licence']}"
    for long, short in _SHORT_TERMS.items():
        name = name.replace(long, short)
    return name


def _classify_terms(terms: str) -> LicenceVerdict:
    if "nd" in terms:
        return LicenceVerdict.NO_DERIVATIVES
    if "nc" in terms:
        return LicenceVerdict.NON_COMMERCIAL
    return LicenceVerdict.SHARE_ALIKE if "sa" in terms else LicenceVerdict.PERMISSIVE
