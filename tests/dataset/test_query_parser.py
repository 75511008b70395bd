"""The query language: any condition selects what plain Python would; whatever else is an error that points at it."""

import operator

import pyarrow as pa
import pyarrow.dataset as ds
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from schemas.tables import OBJECTS, SCENES, TASKS
from tableverse_factory.core.errors import QueryError
from tableverse_factory.dataset.query_parser import MAX_CHARS, MAX_CHOICES, check_columns, parse_filter
from tests.helpers.examples import scale_examples

SCHEMA = pa.schema(
    [("i", pa.int32()), ("f", pa.float64()), ("s", pa.string()), ("b", pa.bool_()), ("l", pa.list_(pa.string()))]
)
NUMBERS = (-2, 0, 1, 3, None)
FLOATS = (-1.5, 0.0, 1.0, 2.5, None)
TEXTS = ("", "mug", "Red Mug", "it's", 'say "x"', "%_.*", None)
ROWS = [
    {"i": i, "f": FLOATS[n % 5], "s": TEXTS[n % 7], "b": (True, False, None)[n % 3], "l": ([], ["a"], None)[n % 3]}
    for n, i in enumerate(NUMBERS * 7)
]
TABLE = pa.Table.from_pylist(ROWS, SCHEMA)
SIGNS = {
    "=": operator.eq,
    "==": operator.eq,
    "!=": operator.ne,
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
}


def selected(text):
    """Numbers of the rows that the expression selects."""
    numbered = TABLE.append_column("n", pa.array(range(len(ROWS))))
    return ds.dataset(numbered).to_table(filter=parse_filter(text, SCHEMA)).column("n").to_pylist()


def quoted(text, quote):
    return quote + text.replace(quote, quote * 2) + quote


def compared(column, sign, value, text):
    def truth(row):
        return None if row[column] is None else SIGNS[sign](row[column], value)

    return f"{column} {sign} {text}", truth


def negated(pair):
    text, truth = pair
    return f"not ({text})", lambda row: None if truth(row) is None else not truth(row)


def joined(word, pairs):
    texts, truths = zip(*pairs, strict=True)
    decisive = word == "or"

    def truth(row):
        """Three-valued logic, as in SQL."""
        values = [t(row) for t in truths]
        return decisive if decisive in values else None if None in values else not decisive

    return f" {word} ".join(f"({text})" for text in texts), truth


signs = st.sampled_from(sorted(SIGNS))
quotes = st.sampled_from("'\"")
some_text = st.sampled_from([t for t in TEXTS if t is not None]) | st.text(max_size=4)


@st.composite
def predicates(draw):
    kind = draw(st.sampled_from(["number", "text", "truth", "null", "in", "contains", "columns", "bare"]))
    column, word = draw(st.sampled_from("if")), draw(some_text)
    written = quoted(word, draw(quotes))
    if kind == "number":
        value = draw(st.integers(-3, 4) | st.floats(-3, 4, allow_nan=False))
        return compared(column, draw(signs), value, repr(value))
    if kind == "text":
        sign = draw(signs)
        return (
            f"s {sign} {written}",
            lambda row: None if row["s"] is None else SIGNS[sign](row["s"].encode(), word.encode()),
        )
    if kind == "truth":
        value = draw(st.booleans())
        return compared(
            "b", draw(st.sampled_from(["=", "!="])), value, draw(st.sampled_from([str(value), f"{value}".lower()]))
        )
    if kind == "null":
        name, wanted = draw(st.sampled_from("ifsbl")), draw(st.booleans())
        return f"{name} is {'' if wanted else 'NOT '}null", lambda row: (row[name] is None) == wanted
    if kind == "in":
        values = draw(st.lists(st.integers(-3, 4), min_size=1, max_size=4))
        text = f"{column} in ({', '.join(map(str, values))})"
        return text, lambda row: None if row[column] is None else row[column] in values
    if kind == "contains":
        word = "".join(c for c in word if c.isascii())
        text = f"s contains {quoted(word, draw(quotes))}"
        return text, lambda row: None if row["s"] is None else word.lower() in row["s"].lower()
    if kind == "columns":
        sign = draw(signs)
        return f"i {sign} f", lambda row: None if None in (row["i"], row["f"]) else SIGNS[sign](row["i"], row["f"])
    return "b", lambda row: row["b"]


conditions = st.recursive(
    predicates(),
    lambda inner: (
        inner.map(negated) | st.builds(joined, st.sampled_from(["and", "or"]), st.lists(inner, min_size=1, max_size=3))
    ),
    max_leaves=8,
)


@pytest.mark.heavy
@settings(max_examples=scale_examples(300), deadline=None)
@given(conditions)
def test_a_condition_selects_what_python_selects(condition):
    text, truth = condition
    assert selected(text) == [n for n, row in enumerate(ROWS) if truth(row) is True], text


@pytest.mark.parametrize(
    ("a", "b"),
    [
        ("i = 1 or i = 3 and f > 2", "i = 1 or (i = 3 and f > 2)"),
        ("not b and i = 1", "(not b) and i = 1"),
        ("not i = 1", "i != 1"),
        ("i not in (1, 3)", "not i in (1, 3)"),
        ("s not contains 'mug'", "not (s contains 'MUG')"),
        ("0 < i", "i > 0"),
        ("i<-1", "i < -1"),
        ("i=+1", "i = 1.0"),
        ("f = .5e1 OR f = 1.", "f = 5 or f = 1"),
        ("s in ('mug')", 's == "mug"'),
        ("i = 3000000000", "b and not b"),  # beyond the column's 32 bits
        ("i < 99999999999999999999", "i is not null"),
        ("\n\tb  ", "b"),
    ],
)
def test_equal_conditions_select_the_same(a, b):
    assert selected(a) == selected(b)


def test_conditions_reach_the_files(tmp_path):
    """Predicates are pushed down to Parquet, where other code runs than in memory."""
    pq.write_table(TABLE, tmp_path / "a.parquet", row_group_size=4)
    stored = ds.dataset(tmp_path / "a.parquet", schema=SCHEMA)
    for text in ("i < 99999999999", "i = 3000000000", "i < 0.5", "s contains 'mug' and f is null", "i not in (1, 2.5)"):
        assert stored.to_table(filter=parse_filter(text, SCHEMA)).num_rows == len(selected(text)), text


ERRORS = [
    ("", 0, "the condition is empty"),
    ("   ", 0, "the condition is empty"),
    ("mas < 1", 0, "no column 'mas'"),
    ("i < 'a'", 4, "i holds numbers, not texts"),
    ("'a' < i", 0, "i holds numbers, not texts"),
    ("s = 1", 4, "s holds texts, not numbers"),
    ("s = mug", 4, "no column 'mug'; write a text in quotes: 'mug'"),
    ("b < true", 2, "does not order"),
    ("b = 1", 4, "true or false"),
    ("l = 'a'", 4, "lists"),
    ("l contains 'a'", 0, "lists"),
    ("i contains '1'", 0, "numbers"),
    ("s contains 1", 11, "text in quotes"),
    ("s contains s", 11, "text in quotes"),
    ("i = null", 4, "is null"),
    ("i is 3", 5, "expected 'null'"),
    ("i in 3", 5, "expected '('"),
    ("i in ()", 6, "expected a column or a value"),
    ("i in (1, 'a')", 9, "numbers, not texts"),
    ("i in (f)", 6, "'f' is a column"),
    ("i in (1 2)", 8, "expected ')'"),
    ("1 = 1", 0, "no column"),
    ("true", 0, "compare it with a column"),
    ("i", 1, "expected a comparison"),
    ("not s", 5, "expected a comparison"),
    ("i < 1 and", 9, "expected a column"),
    ("i < 1 i < 2", 6, "expected and, or"),
    ("(i < 1", 6, "expected ')'"),
    ("i < 1)", 5, "expected and, or"),
    ("i < 1; drop", 5, "';' is not understood"),
    ("s = '\udcff'", 4, "is not UTF-8"),
    ("i < 1 && b", 6, "write and"),
    ("b || b", 2, "write or"),
    ("s = 'open", 4, "not closed"),
    ("s like 'a%'", 2, "contains"),
    ("i < 1e999", 4, "too large"),
    ("i < 1.2.3", 4, "not understood"),
    ("i < 0x10", 4, "not understood"),
    ("i < 1_000", 4, "not understood"),
    ("i < nan", 4, "no column 'nan'"),
    ("i + 1 = 2", 2, "not understood"),
    ("s[0] = 'a'", 1, "not understood"),
    ("s.upper() = 'A'", 1, "not understood"),
    ("__import__('os')", 0, "no column '__import__'"),
    ("__import__('os').system('id')", 16, "not understood"),
    ("(lambda: 1)()", 7, "not understood"),
    ("s = 'a' -- b", 8, "not understood"),
    ("s\x1b[2J = 'a'", 1, "not understood"),
    ("ｓ = 'a'", 0, "not understood"),
    ("(" * 60 + "b" + ")" * 60, 50, "nested deeper"),
    ("not " * 60 + "b", 200, "nested deeper"),
    ("i in (" + ",".join("1" * 1100) + ")", None, str(MAX_CHOICES)),
]


@pytest.mark.parametrize(("text", "column", "words"), ERRORS, ids=[text[:30] for text, _, _ in ERRORS])
def test_an_error_points_at_its_column(text, column, words):
    with pytest.raises(QueryError) as caught:
        parse_filter(text, SCHEMA)
    message, line, carets = str(caught.value).split("\n")
    assert words in message
    assert (message + line).isprintable()
    start = carets.index("^")
    assert carets.strip() == "^" * (len(carets) - start)
    if column is not None:
        assert start - 2 + max(0, column - 60) == column
        assert line[start : start + 1] in ("", text[column : column + 1], "·")


@given(st.text(alphabet="ifsbl()<=!>'\" 12.,-+andorinotx\0\x1b", max_size=60) | st.text(max_size=60))
def test_any_text_is_a_condition_or_a_query_error(text):
    said = ""
    try:
        selected(text)
    except QueryError as error:
        said = str(error)
    assert all(line.isprintable() for line in said.split("\n"))


def test_length_is_bounded_and_long_chains_are_fine():
    with pytest.raises(QueryError, match=str(MAX_CHARS)):
        parse_filter("b or " * MAX_CHARS + "b", SCHEMA)
    assert selected(" or ".join(["b"] * 1900)) == selected("b")
    assert selected("i in (" + ",".join(["1"] * MAX_CHOICES) + ")") == selected("i = 1")


@pytest.mark.parametrize(
    ("name", "schema", "nearest"),
    [
        ("mas_kg", OBJECTS, "mass_kg"),
        ("Label", OBJECTS, "label"),
        ("quality", SCENES, "quality_score"),
        ("penetration", SCENES, "mesh_penetration_m"),
    ],
)
def test_the_nearest_column_is_suggested(name, schema, nearest):
    with pytest.raises(QueryError, match=f"did you mean {nearest}"):
        parse_filter(f"{name} = 1", schema)
    with pytest.raises(QueryError, match=f"did you mean {nearest}"):
        check_columns(["scene_id", name], schema)


@pytest.mark.parametrize(
    ("name", "schema", "advice"),
    [
        ("label", SCENES, "objects has it: give --table objects"),
        ("instruction", OBJECTS, "tasks and trajectories have it: give --table tasks"),
        ("status", TASKS, "scenes has it: give --table scenes"),
    ],
)
def test_a_column_of_another_table_is_found_there(name, schema, advice):
    with pytest.raises(QueryError, match=advice):
        parse_filter(f"{name} = 'mug'", schema)
    with pytest.raises(QueryError, match=advice):
        check_columns([name], schema)


def test_known_columns_pass_in_their_order():
    assert check_columns(["label", "scene_id"], OBJECTS) == ["label", "scene_id"]
