"""The expression language of `query --where`: text in, a pyarrow expression out, nothing is ever evaluated as code.

expression := and_part { "or" and_part }
and_part   := negation { "and" negation }
negation   := "not" negation | "(" expression ")" | predicate
predicate  := operand ("=" | "==" | "!=" | "<" | "<=" | ">" | ">=") operand
            | column ["not"] "in" "(" literal { "," literal } ")"
            | column "is" ["not"] "null"
            | column ["not"] "contains" text
            | column                                            (true or false)
operand    := column | literal
literal    := number | 'text' | "text" | "true" | "false"       (a quote inside is doubled)

As in SQL, a comparison with a missing value is neither true nor false, and its row is not selected; `contains` ignores
case.
"""

import bisect
import difflib
import functools
import itertools
import operator
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import pyarrow as pa
import pyarrow.compute as pc

from schemas.arrow import TABLES
from tableverse_factory.core.errors import QueryError
from tableverse_factory.dataset.query_lexer import Token, make_query_error, tokenize, unquote

MAX_CHARS = 10_000
MAX_DEPTH = 50
MAX_CHOICES = 1000
_LISTED_CHARS = 240
_LEAST_CHARS = 3

_COMPARE: dict[str, Callable[[pc.Expression, pc.Expression], pc.Expression]] = {
    "=": operator.eq,
    "==": operator.eq,
    "!=": operator.ne,
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
}
_FOREIGN = {"like": "write: column contains 'text'", "between": "write: a <= column and column <= b"}


@dataclass(frozen=True, slots=True)
class _Operand:
    """One side of a predicate: its expression, whether it is number, text, truth or list, and where it stands."""

    expression: pc.Expression
    kind: str
    is_column: bool
    token: Token


def parse_filter(text: str, schema: pa.Schema) -> pc.Expression:
    """The condition as a pyarrow expression over the columns of `schema`.

    Raises:
        QueryError: if it does not parse, names no column or compares unlike things; its second and third line show
            the place.
    """
    if len(text) > MAX_CHARS:
        raise QueryError(f"the expression has {len(text)} characters; at most {MAX_CHARS} are read")
    return _Parser(text, schema).whole()


def check_columns(names: Sequence[str], schema: pa.Schema) -> list[str]:
    """The names unchanged.

    Raises:
        QueryError: for a name that is no column, with the nearest.
    """
    for name in names:
        if name not in schema.names:
            raise QueryError(f"no column {name[:80]!r}; {_nearest(name, schema)}")
    return list(names)


class _Parser:
    """Recursive descent, one method per rule of the grammar."""

    def __init__(self, text: str, schema: pa.Schema) -> None:
        self._text = text
        self._schema = schema
        self._tokens = tokenize(text)
        self._next = 0

    def whole(self) -> pc.Expression:
        expression = self._expression(0)
        if self._token.kind != "end":
            raise self._error(f"expected and, or, or the end; found {self._token.shown}", self._token)
        return expression

    @property
    def _token(self) -> Token:
        return self._tokens[self._next]

    def _take(self, *texts: str) -> bool:
        """Steps over the next token if it is one of these keywords or signs."""
        if self._token.kind in ("keyword", "sign") and self._token.text in texts:
            self._next += 1
            return True
        return False

    def _expect(self, text: str) -> None:
        if not self._take(text):
            raise self._error(f"expected {text!r}; found {self._token.shown}", self._token)

    def _expression(self, depth: int) -> pc.Expression:
        parts = [self._and_part(depth)]
        while self._take("or"):
            parts.append(self._and_part(depth))
        return _balanced(operator.or_, parts)

    def _and_part(self, depth: int) -> pc.Expression:
        parts = [self._negation(depth)]
        while self._take("and"):
            parts.append(self._negation(depth))
        return _balanced(operator.and_, parts)

    def _negation(self, depth: int) -> pc.Expression:
        if depth >= MAX_DEPTH:
            raise self._error(f"nested deeper than {MAX_DEPTH} levels", self._token)
        if self._take("not"):
            return ~self._negation(depth + 1)
        if self._take("("):
            inner = self._expression(depth + 1)
            self._expect(")")
            return inner
        return self._predicate()

    def _predicate(self) -> pc.Expression:
        left = self._operand()
        sign = self._token
        if sign.kind == "sign" and sign.text in _COMPARE:
            self._next += 1
            return self._comparison(left, sign, self._operand())
        if not left.is_column:
            raise self._error("a value alone says nothing: compare it with a column", left.token)
        if self._take("is"):
            negated = self._take("not")
            self._expect("null")
            return left.expression.is_valid() if negated else left.expression.is_null()
        negated = self._token.text == "not" and self._take("not")
        if self._take("in"):
            found = self._choices(left)
        elif self._take("contains"):
            found = self._contains(left)
        elif left.kind == "truth" and not negated:
            return left.expression
        else:
            raise self._unfinished(left)
        return ~found if negated else found

    def _comparison(self, left: _Operand, sign: Token, right: _Operand) -> pc.Expression:
        if not (left.is_column or right.is_column):
            raise self._error("two values and no column", left.token)
        self._same_kind(left, right)
        if left.kind == "list" or (left.kind == "truth" and sign.text not in ("=", "==", "!=")):
            raise self._error(f"{sign.text} does not order {_NAMES[left.kind]}", sign)
        return _COMPARE[sign.text](left.expression, right.expression)

    def _choices(self, column: _Operand) -> pc.Expression:
        self._expect("(")
        values = [self._choice(column)]
        while self._take(","):
            values.append(self._choice(column))
            if len(values) > MAX_CHOICES:
                raise self._error(f"more than {MAX_CHOICES} values", self._token)
        self._expect(")")
        return _balanced(operator.or_, [column.expression == value for value in values])

    def _choice(self, column: _Operand) -> pc.Expression:
        value = self._operand()
        if value.is_column:
            raise self._error(f"{value.token.text!r} is a column; texts stand in quotes", value.token)
        self._same_kind(column, value)
        return value.expression

    def _contains(self, column: _Operand) -> pc.Expression:
        if column.kind != "text":
            raise self._error(
                f"contains looks into texts; {column.token.text} holds {_NAMES[column.kind]}", column.token
            )
        if self._token.kind != "text":
            raise self._error(f"expected a text in quotes; found {self._token.shown}", self._token)
        wanted = unquote(self._token)
        self._next += 1
        return pc.match_substring(column.expression, wanted, ignore_case=True)

    def _operand(self) -> _Operand:
        token = self._token
        self._next += token.kind != "end"
        if token.kind == "number":
            return _Operand(pc.scalar(self._number(token)), "number", False, token)
        if token.kind == "text":
            return _Operand(pc.scalar(unquote(token)), "text", False, token)
        if token.kind == "keyword" and token.text in ("true", "false"):
            return _Operand(pc.scalar(token.text == "true"), "truth", False, token)
        if token.kind == "word":
            if token.text not in self._schema.names:
                raise self._error(f"no column {token.text!r}; {_nearest(token.text, self._schema)}", token)
            kind = _kind_of(self._schema.field(token.text).type)
            return _Operand(pc.field(token.text), kind, True, token)
        hint = "; write: column is null" if token.text == "null" else ""
        raise self._error(f"expected a column or a value; found {token.shown}{hint}", token)

    def _number(self, token: Token) -> int | float:
        whole = re.fullmatch(r"[+-]?\d{1,18}", token.text)
        value = int(token.text) if whole else float(token.text)
        if value in (float("inf"), float("-inf")):
            raise self._error("the number is too large", token)
        return value

    def _same_kind(self, left: _Operand, right: _Operand) -> None:
        if left.kind == right.kind:
            return
        column, other = (left, right) if left.is_column else (right, left)
        holds = f"{column.token.text} holds {_NAMES[column.kind]}"
        raise self._error(f"{holds}, not {_NAMES[other.kind]}", other.token)

    def _unfinished(self, left: _Operand) -> QueryError:
        token = self._token
        hint = _FOREIGN.get(token.text.lower(), "expected a comparison, in, is null or contains")
        return self._error(f"after {left.token.text}: {hint}; found {token.shown}", token)

    def _error(self, message: str, token: Token) -> QueryError:
        return make_query_error(message, self._text, token)


_NAMES = {"number": "numbers", "text": "texts", "truth": "true or false", "list": "lists"}


def _kind_of(kind: pa.DataType) -> str:
    if pa.types.is_boolean(kind):
        return "truth"
    if pa.types.is_integer(kind) or pa.types.is_floating(kind):
        return "number"
    return "text" if pa.types.is_string(kind) or pa.types.is_large_string(kind) else "list"


def _balanced(
    join: Callable[[pc.Expression, pc.Expression], pc.Expression], parts: Sequence[pc.Expression]
) -> pc.Expression:
    """The parts joined as a shallow tree: a chain of thousands would overflow Arrow's stack."""
    if len(parts) <= 2:
        return functools.reduce(join, parts)
    middle = len(parts) // 2
    return join(_balanced(join, parts[:middle]), _balanced(join, parts[middle:]))


def _nearest(name: str, schema: pa.Schema) -> str:
    """What to write instead: the same column of another table, or the nearest one of this."""
    others = [table for table, columns in TABLES.items() if name in columns.names]
    if others:
        return f"{' and '.join(others)} {'has' if len(others) == 1 else 'have'} it: give --table {others[0]}"
    if close := _close(name, schema.names, 0.5):
        return f"did you mean {close}?"
    for table, columns in TABLES.items():
        if close := _close(name, columns.names, 0.6):
            return f"did you mean {close} of another table? give --table {table}"
    first = _as_many_as_fit(schema.names)
    more = "" if len(first) == len(schema.names) else ", … (all: --columns all --limit 1)"
    return f"columns are {', '.join(first)}{more}"


def _close(name: str, known: Sequence[str], cutoff: float) -> str | None:
    """The nearest of the names: one that begins with it, such as `mass_kg` for `mass`, or one that is spelt alike."""
    asked = name.lower()
    begun = [column for column in known if len(asked) >= _LEAST_CHARS and column.startswith(f"{asked}_")]
    return next(iter(begun or difflib.get_close_matches(asked, known, n=1, cutoff=cutoff)), None)


def _as_many_as_fit(names: Sequence[str]) -> Sequence[str]:
    """The first names, whole, within the length of a message."""
    ends = list(itertools.accumulate(len(name) + 2 for name in names))
    return names[: bisect.bisect_right(ends, _LISTED_CHARS)]
