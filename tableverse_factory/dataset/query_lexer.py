"""The words of a `query --where` expression, and the error that points at one of them."""

import re
from dataclasses import dataclass

from tableverse_factory.core.errors import QueryError

_TOKEN = re.compile(
    r"""\s*(?:(?P<number>[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)(?![\w.])
    |(?P<text>'(?:[^']|'')*'|"(?:[^"]|"")*")
    |(?P<word>[A-Za-z_]\w*)
    |(?P<sign><=|>=|==|!=|[=<>(),]))""",
    re.VERBOSE | re.ASCII,
)
_KEYWORDS = ("and", "or", "not", "in", "is", "null", "contains", "true", "false")
_HINTS = {
    "&": "; write and",
    "|": "; write or",
    "!": "; write not, or != between two values",
    "'": ": the quote is not closed",
    '"': ": the quote is not closed",
}
_SHOWN_CHARS = 60


@dataclass(frozen=True, slots=True)
class Token:
    """A piece of the text: `kind` is number, text, word, keyword, sign or end."""

    kind: str
    text: str
    start: int
    end: int

    @property
    def shown(self) -> str:
        """As messages name it."""
        return self.text if self.kind == "end" else repr(self.text)


def tokenize(text: str) -> list[Token]:
    """The pieces in order, `end` last.

    Raises:
        QueryError: at a character that begins no piece.
    """
    tokens, position, end = [], 0, len(text.rstrip())
    while position < end:
        match = _TOKEN.match(text, position)
        if match is None:
            start = end - len(text[position:end].lstrip())
            bad = Token("end", text[start], start, start + 1)
            raise make_query_error(f"{bad.text!r} is not understood{_HINTS.get(bad.text, '')}", text, bad)
        kind = str(match.lastgroup)
        found = match[kind].lower() if match[kind].lower() in _KEYWORDS else match[kind]
        tokens.append(Token("keyword" if found in _KEYWORDS else kind, found, match.start(kind), match.end()))
        position = match.end()
    return [*tokens, Token("end", "the end", end, end + 1)]


def unquote(token: Token) -> str:
    """What a text token says: without its quotes, a doubled quote inside as one."""
    return token.text[1:-1].replace(token.text[0] * 2, token.text[0])


def make_query_error(message: str, text: str, token: Token) -> QueryError:
    """The message, then the expression around the token, then carets below it."""
    first = max(0, token.start - _SHOWN_CHARS)
    line = _visible(text[first : token.start + _SHOWN_CHARS])
    carets = "^" * max(1, min(token.end, first + len(line)) - token.start)
    return QueryError(f"{_visible(message)[:500]}\n  {line}\n  {' ' * (token.start - first)}{carets}")


def _visible(text: str) -> str:
    """Same length, so that the carets stay below what they point at."""
    return "".join(c if c.isprintable() else "·" for c in text)
