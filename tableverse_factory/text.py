"""Untrusted text on its way to a terminal or a log: one bounded line without control characters."""


def printable(text: str, limit: int = 200) -> str:
    r"""`text` on one line, at most `limit` characters, everything unprintable (escapes, newlines) as `\x1b`."""
    shown = text[: limit + 1]
    shown = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in shown)
    return shown if len(shown) <= limit else shown[: limit - 1] + "…"
