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

from schemas.tables import TABLES
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
    """One side of a predicate: its expression, its kind (number, text, truth or list), and its token."""

    expression: pc.Expression
    kind: str
    is_column: bool
    token: Token


def parse_filter(text: str, schema: pa.Schema) -> pc.Expression:
    """Parse a condition into a pyarrow expression over the columns of `schema`."""
    if len(text) > MAX_CHARS:
        raise QueryError(f"the expression has {len(text)} characters; at most {MAX_CHARS} are read")
    return _Parser(text, schema).parse()


def check_columns(names: Sequence[str], schema: pa.Schema) -> list[str]:
    """Return the names if all are columns."""
    for name in names:
        if name not in schema.names:
            raise QueryError(f"no column {name[:80]!r}; {_suggest_column(name, schema)}")
    return list(names)


class _Parser:
    """Recursive descent parser with one method per rule of the grammar."""

    def __init__(self, text: str, schema: pa.Schema) -> None:
        self._text = text
        self._schema = schema
        self._tokens = tokenize(text)
        self._next = 0

    def parse(self) -> pc.Expression:
        if self._token.kind == "end":
            raise self._make_error("the condition is empty: expected a column or a value", self._token)
        expression = self._parse_expression(0)
        if self._token.kind != "end":
            raise self._make_error(f"expected and, or, or the end; found {self._token.shown}", self._token)
        return expression

    @property
    def _token(self) -> Token:
        return self._tokens[self._next]

    def _take(self, *texts: str) -> bool:
        """Consume the next token if it is one of these keywords or signs."""
        if self._token.kind in ("keyword", "sign") and self._token.text in texts:
            self._next += 1
            return True
        return False

    def _expect(self, text: str) -> None:
        if not self._take(text):
            raise self._make_error(f"expected {text!r}; found {self._token.shown}", self._token)

    def _parse_expression(self, depth: int) -> pc.Expression:
        parts = [self._parse_and_part(depth)]
        while self._take("or"):
            parts.append(self._parse_and_part(depth))
        return _join_balanced(operator.or_, parts)

    def _parse_and_part(self, depth: int) -> pc.Expression:
        parts = [self._parse_negation(depth)]
        while self._take("and"):
            parts.append(self._parse_negation(depth))
        return _join_balanced(operator.and_, parts)

    def _parse_negation(self, depth: int) -> pc.Expression:
        if depth >= MAX_DEPTH:
            raise self._make_error(f"nested deeper than {MAX_DEPTH} levels", self._token)
        if self._take("not"):
            return ~self._parse_negation(depth + 1)
        if self._take("("):
            inner = self._parse_expression(depth + 1)
            self._expect(")")
            return inner
        return self._parse_predicate()

    def _parse_predicate(self) -> pc.Expression:
        left = self._parse_operand()
        sign = self._token
        if sign.kind == "sign" and sign.text in _COMPARE:
            self._next += 1
            return self._parse_comparison(left, sign, self._parse_operand())
        if not left.is_column:
            raise self._make_error("a value alone says nothing: compare it with a column", left.token)
        if self._take("is"):
            negated = self._take("not")
            self._expect("null")
            return left.expression.is_valid() if negated else left.expression.is_null()
        negated = self._token.text == "not" and self._take("not")
        if self._take("in"):
            found = self._parse_choices(left)
        elif self._take("contains"):
            found = self._parse_contains(left)
        elif left.kind == "truth" and not negated:
            return left.expression
        else:
            raise self._make_unfinished_error(left)
        return ~found if negated else found

    def _parse_comparison(self, left: _Operand, sign: Token, right: _Operand) -> pc.Expression:
        if not (left.is_column or right.is_column):
            raise self._make_error("two values and no column", left.token)
        self._check_same_kind(left, right)
        if left.kind == "list" or (left.kind == "truth" and sign.text not in ("=", "==", "!=")):
            raise self._make_error(f"{sign.text} does not order {_NAMES[left.kind]}", sign)
        return _COMPARE[sign.text](left.expression, right.expression)

    def _parse_choices(self, column: _Operand) -> pc.Expression:
        self._expect("(")
        values = [self._parse_choice(column)]
        while self._take(","):
            values.append(self._parse_choice(column))
            if len(values) > MAX_CHOICES:
                raise self._make_error(f"more than {MAX_CHOICES} values", self._token)
        self._expect(")")
        return _join_balanced(operator.or_, [column.expression == value for value in values])

    def _parse_choice(self, column: _Operand) -> pc.Expression:
        value = self._parse_operand()
        if value.is_column:
            raise self._make_error(f"{value.token.text!r} is a column; texts stand in quotes", value.token)
        self._check_same_kind(column, value)
        return value.expression

    def _parse_contains(self, column: _Operand) -> pc.Expression:
        if column.kind != "text":
            raise self._make_error(
                f"contains looks into texts; {column.token.text} holds {_NAMES[column.kind]}", column.token
            )
        if self._token.kind != "text":
            raise self._make_error(f"expected a text in quotes; found {self._token.shown}", self._token)
        wanted = unquote(self._token)
        self._next += 1
        return pc.match_substring(column.expression, wanted, ignore_case=True)

    def _parse_operand(self) -> _Operand:
        token = self._token
        self._next += token.kind != "end"
        if token.kind == "number":
            return _Operand(pc.scalar(self._parse_number(token)), "number", False, token)
        if token.kind == "text":
            return _Operand(pc.scalar(unquote(token)), "text", False, token)
        if token.kind == "keyword" and token.text in ("true", "false"):
            return _Operand(pc.scalar(token.text == "true"), "truth", False, token)
        if token.kind == "word":
            if token.text not in self._schema.names:
                hint = _suggest_column(token.text, self._schema)
                if self._next > 1 and self._tokens[self._next - 2].text in _COMPARE:  # on the right a text is meant
                    hint = f"write a text in quotes: '{token.text[:80]}'"
                raise self._make_error(f"no column {token.text!r}; {hint}", token)
            kind = _classify_type(self._schema.field(token.text).type)
            return _Operand(pc.field(token.text), kind, True, token)
        hint = "; write: column is null" if token.text == "null" else ""
        raise self._make_error(f"expected a column or a value; found {token.shown}{hint}", token)

    def _parse_number(self, token: Token) -> int | float:
        parse = re.fullmatch(r"[+-]?\d{1,18}", token.text)
        value = int(token.text) if parse else float(token.text)
        if value in (float("inf"), float("-inf")):
            raise self._make_error("the number is too large", token)
        return value

    def _check_same_kind(self, left: _Operand, right: _Operand) -> None:
        if left.kind == right.kind:
            return
        column, other = (left, right) if left.is_column else (right, left)
        holds = f"{column.token.text} holds {_NAMES[column.kind]}"
        raise self._make_error(f"{holds}, not {_NAMES[other.kind]}", other.token)

    def _make_unfinished_error(self, left: _Operand) -> QueryError:
        token = self._token
        hint = _FOREIGN.get(token.text.lower(), "expected a comparison, in, is null or contains")
        return self._make_error(f"after {left.token.text}: {hint}; found {token.shown}", token)

    def _make_error(self, message: str, token: Token) -> QueryError:
        return make_query_error(message, self._text, token)


_NAMES = {"number": "numbers", "text": "texts", "truth": "true or false", "list": "lists"}


def _classify_type(kind: pa.DataType) -> str:
    if pa.types.is_boolean(kind):
        return "truth"
    if pa.types.is_integer(kind) or pa.types.is_floating(kind):
        return "number"
    return "text" if pa.types.is_string(kind) or pa.types.is_large_string(kind) else "list"


def _join_balanced(
    join: Callable[[pc.Expression, pc.Expression], pc.Expression], parts: Sequence[pc.Expression]
) -> pc.Expression:
    """Join the parts as a shallow tree: a chain of thousands would overflow Arrow's stack."""
    if len(parts) <= 2:
        return functools.reduce(join, parts)
    middle = len(parts) // 2
    return join(_join_balanced(join, parts[:middle]), _join_balanced(join, parts[middle:]))


def _suggest_column(name: str, schema: pa.Schema) -> str:
    """Suggest what to write instead: the same column of another table, or the nearest one of this."""
    others = [table for table, columns in TABLES.items() if name in columns.names]
    if others:
        return f"{' and '.join(others)} {'has' if len(others) == 1 else 'have'} it: give --table {others[0]}"
    if close := _find_close_name(name, schema.names, 0.5):
        return f"did you mean {close}?"
    for table, columns in TABLES.items():
        if close := _find_close_name(name, columns.names, 0.6):
            return f"did you mean {close} of another table? give --table {table}"
    first = _select_fitting(schema.names)
    more = "" if len(first) == len(schema.names) else ", … (all: --columns all --limit 1)"
    return f"columns are {', '.join(first)}{more}"


def _find_close_name(name: str, known: Sequence[str], cutoff: float) -> str | None:
    """Find the nearest name: one that begins with it, such as `mass_kg` for `mass`, or one of similar spelling."""
    asked = name.lower()
    begun = [column for column in known if len(asked) >= _LEAST_CHARS and column.startswith(f"{asked}_")]
    return next(iter(begun or difflib.get_close_matches(asked, known, n=1, cutoff=cutoff)), None)


def _select_fitting(names: Sequence[str]) -> Sequence[str]:
    """Select the first names that fit into a message."""
    ends = list(itertools.accumulate(len(name) + 2 for name in names))
    return names[: bisect.bisect_right(ends, _LISTED_CHARS)]
