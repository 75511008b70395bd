"""Lexer of `query --where` expressions, and the error that points at a token."""

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
    """Token of the text: `kind` is number, text, word, keyword, sign or end."""

    kind: str
    text: str
    start: int
    end: int

    @property
    def shown(self) -> str:
        """The token as messages name it."""
        return self.text if self.kind == "end" else repr(self.text)


def tokenize(text: str) -> list[Token]:
    """Split the text into tokens, `end` last."""
    tokens, position, end = [], 0, len(text.rstrip())
    while position < end:
        match = _TOKEN.match(text, position)
        if match is None:
            start = end - len(text[position:end].lstrip())
            bad = Token("end", text[start], start, start + 1)
            raise make_query_error(f"{bad.text!r} is not understood{_HINTS.get(bad.text, '')}", text, bad)
        kind = str(match.lastgroup)
        if not match[kind].isascii() and any("\ud800" <= c <= "\udfff" for c in match[kind]):  # bytes of the shell
            token = Token(kind, match[kind], match.start(kind), match.end())
            raise make_query_error(f"{token.text!r} is not UTF-8", text, token)
        found = match[kind].lower() if match[kind].lower() in _KEYWORDS else match[kind]
        tokens.append(Token("keyword" if found in _KEYWORDS else kind, found, match.start(kind), match.end()))
        position = match.end()
    return [*tokens, Token("end", "the end", end, end + 1)]


def unquote(token: Token) -> str:
    """Remove the quotes of a text token; a doubled quote inside becomes one."""
    return token.text[1:-1].replace(token.text[0] * 2, token.text[0])


def make_query_error(message: str, text: str, token: Token) -> QueryError:
    """Make an error of the message, the expression around the token, and carets below it."""
    first = max(0, token.start - _SHOWN_CHARS)
    line = _mask_unprintable(text[first : token.start + _SHOWN_CHARS])
    carets = "^" * max(1, min(token.end, first + len(line)) - token.start)
    return QueryError(f"{_mask_unprintable(message)[:500]}\n  {line}\n  {' ' * (token.start - first)}{carets}")


def _mask_unprintable(text: str) -> str:
    """Replace unprintable characters, keeping the length so that the carets stay below their token."""
    return "".join(c if c.isprintable() else "·" for c in text)
