"""Text of messages: untrusted text as one bounded line without control characters, plurals, errors of libraries."""

import json
import re

_TOKEN = re.compile(r"hf_[A-Za-z0-9]{4,}|(?i:bearer\s+\S+)")
_QUERY = re.compile(r"\?[^\s\"'<>)]*")
_IRREGULAR_PLURALS = (
    "people:person men:man women:woman children:child feet:foot gentlemen:gentleman knives:knife loaves:loaf "
    "halves:half shelves:shelf leaves:leaf mice:mouse glasses:glasses scissors:scissors"
)
_IRREGULAR = dict(pair.split(":") for pair in _IRREGULAR_PLURALS.split())
_HOST = re.compile(r"(?<=://)[^/\s\"'<>)?]*")


def sanitize_line(text: str, limit: int = 200) -> str:
    r"""Make text one printable line of at most `limit` characters; unprintable ones are escaped as in `\x1b`."""
    shown = text[: limit + 1]
    shown = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in shown)
    return shown if len(shown) <= limit else shown[: limit - 1] + "…"


def redact_secrets(text: str) -> str:
    """Reduce a text to one short line without tokens, hosts, users, and queries of addresses, which may be signed."""
    plain = _QUERY.sub("", _TOKEN.sub("…", _HOST.sub("…", " ".join(text.split()))))
    return sanitize_line(plain, 300)


def describe_change(name: str, before: object, now: object) -> str:
    """Describe a change of a value in one line."""
    return sanitize_line(f"{name} was {before!r} and is now {now!r}", 400)


def pluralize(number: int, noun: str) -> str:
    """Format a number with a noun that takes an s: `1 row`, `2 rows`."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def to_singular(word: str) -> str:
    """Turn a lower-case English noun into its singular; *glasses* and *scissors* are words of their own."""
    if word in _IRREGULAR:
        return _IRREGULAR[word]
    if len(word) > 4 and word.endswith("ies"):
        return f"{word[:-3]}y"
    if len(word) > 4 and word.endswith(("ches", "shes", "xes", "sses", "oes")):
        return word[:-2]
    return word[:-1] if len(word) > 3 and word.endswith("s") and not word.endswith(("ss", "us", "is")) else word


def describe_error(error: BaseException) -> str:
    """Describe an error: the system's words without number and path, a parser's with the place."""
    if isinstance(error, OSError) and error.strerror:
        return f"{error.strerror[:1].lower()}{error.strerror[1:]}"
    if isinstance(error, json.JSONDecodeError):
        return f"{error.msg[:1].lower()}{error.msg[1:]}, line {error.lineno}, column {error.colno}"
    if isinstance(error, UnicodeDecodeError):
        return f"it is no text in {error.encoding.upper()}, from byte {error.start}"
    if isinstance(error, RecursionError):
        return "it is nested too deeply"
    return " ".join(str(error).split()) or type(error).__name__
