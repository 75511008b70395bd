"""Ids are safe as file names, labels are one clean line, hashes tell parts apart."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.identity import MAX_LABEL_CHARS, check_id, clean_label, content_hash, make_object_id


@pytest.mark.parametrize("good", ["a", "obj_000", "osd_learn0-1a2b3c", "A.b-c_9", "x" * 80])
def test_good_ids_pass_unchanged(good):
    assert check_id(good) == good


@pytest.mark.parametrize(
    "bad",
    ["", ".", "..", "../../x", "a/b", "a\\b", "a..b", "-rf", "_x", ".hidden", "a b", "a\n", "é", "x" * 81, "a\0", "/x"],
)
def test_ids_that_could_be_a_path_are_refused(bad):
    with pytest.raises(ValueError, match="not usable"):
        check_id(bad)


@given(st.text(max_size=120))
def test_what_passes_is_a_file_name_of_this_folder(text):
    try:
        check_id(text)
    except ValueError:
        return
    assert text.isascii()
    assert text.isprintable()
    assert not set(text) & set("/\\ :*?\"<>|'&;$`")
    assert text not in (".", "..")
    assert not text.startswith((".", "-"))


@given(st.integers(0, 99_999))
def test_object_ids_are_ids(index):
    assert check_id(make_object_id(index)).startswith("obj_")


def test_object_ids_sort_like_their_numbers():
    ids = [make_object_id(index) for index in range(200)]
    assert sorted(ids) == ids


@pytest.mark.heavy
@given(st.text(max_size=400))
def test_labels_are_one_clean_line(text):
    label = clean_label(text)
    assert 1 <= len(label) <= MAX_LABEL_CHARS
    assert label.isprintable()
    assert label == label.strip()
    assert clean_label(label) == label


@pytest.mark.parametrize(
    ("text", "label"),
    [
        ("  red\tmug\n", "red mug"),
        ("\x1b[2Jmug", "[2Jmug"),
        ("", "object"),
        ("\0\u200b\u202e", "object"),
        ("Tasse à café", "Tasse à café"),
        ('"/><x a="', '"/><x a="'),  # text stays text; who writes XML escapes it
    ],
)
def test_labels_by_example(text, label):
    assert clean_label(text) == label


@given(st.lists(st.binary(max_size=8), max_size=5), st.lists(st.binary(max_size=8), max_size=5))
def test_hashes_are_equal_only_for_equal_parts(a, b):
    assert (content_hash(*a) == content_hash(*b)) == (a == b)


def test_a_byte_that_moves_to_the_next_part_changes_the_hash():
    assert content_hash(b"ab", b"c") != content_hash(b"a", b"bc")
    assert content_hash(b"") != content_hash()
