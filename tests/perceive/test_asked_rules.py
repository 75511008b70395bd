"""What a model says, read and held to the rules of appendix A: each rule by what would hurt without it."""

import json

import pytest

from schemas.detection import MAX_DETECTIONS
from tableverse_factory.errors import AnswerInvalidError
from tableverse_factory.perceive.asked_reading import read_answer
from tableverse_factory.perceive.asked_rules import NO_TABLE, Ruled, keep_rules
from tableverse_factory.perceive.asked_words import names_no_solid, names_person, names_table, same_name

SENT = (1536, 1152)
TABLE = {"label": "table", "bbox_xyxy": [0, 300, 1000, 1000]}


def ruled(*things, composites=(), table=TABLE, **more) -> Ruled:
    listed = [*([table] if table else []), *things]
    text = json.dumps({"detections": listed, "composites": list(composites), **more})
    return keep_rules(read_answer(text, "xyxy", SENT))


def thing(label, *box, **more):
    return {"label": label, "bbox_xyxy": list(box or (100, 400, 200, 500)), **more}


def part(label, *box, **more):
    return {"label": label, "bbox": list(box), **more}


def filled(container, *contents):
    return {"type": "container_fill", "description": "", "container": container, "contents": list(contents)}


def singles(found: Ruled) -> list[str]:
    return [item.label for item in found.answer.detections]


def composites(found: Ruled) -> list[tuple[str, list[tuple[str, int]]]]:
    return [
        (c.container.label, [(inside.label, inside.count) for inside in c.contents]) for c in found.answer.composites
    ]


def said(found: Ruled) -> list[tuple[str, str]]:
    return [(remark.where, remark.rule) for remark in found.remarks]


BOWL = part("bowl", 300, 400, 500, 600)
APPLE = part("apple", 330, 420, 400, 500, count=3)


def test_an_answer_that_keeps_the_rules_comes_through_as_it_is():
    spoon = thing("spoon", 700, 500, 800, 560, score=0.7, description="a steel\nspoon")
    found = ruled(spoon, composites=[filled(BOWL, APPLE)], people=[])
    assert found.table
    assert found.remarks == ()
    assert singles(found) == ["table", "spoon"]
    assert found.answer.detections[1].bbox_xyxy == (700, 500, 800, 560)
    assert (found.answer.detections[1].score, found.answer.detections[1].description) == (0.7, "a steel spoon")
    assert composites(found) == [("bowl", [("apple", 3)])]


# One table.


def test_several_tables_are_one_the_largest():
    found = ruled(thing("desk", 0, 350, 300, 600), thing("wooden table", 0, 200, 1000, 1000), thing("mug"))
    assert singles(found) == ["table", "mug"]
    assert found.answer.detections[0].bbox_xyxy == (0, 200, 1000, 1000)
    assert said(found) == [("detections[0]", "second_table"), ("detections[1]", "second_table")]


def test_without_a_table_the_model_is_told_so_unless_it_sees_nothing_at_all():
    with pytest.raises(AnswerInvalidError, match="labelled 'table'") as error:
        ruled(thing("mug"), table=None)
    assert error.value.reason == NO_TABLE
    assert not ruled(table=None).table


def test_a_table_contains_nothing():
    on_it = filled(part("dining table", 0, 300, 1000, 1000), part("mug", 100, 400, 200, 500))
    found = ruled(table=None, composites=[on_it])
    assert singles(found) == ["table", "mug"]
    assert composites(found) == []


# Nobody's hand.

PEOPLE = """hand|hands|Left hand|person's hand|human arm|forearms|hand holding a cup|man in a red shirt|two people
hand_2|hand (left)|fingers|a woman’s hand|hand of a child|hand cutting bread|woman and child|body part|bare feet|face
ｈａｎｄ|child's fingertips|hand and cup|baby|men|HANDS|right elbow|person 1|wrist with watch|head of a man|chef"""
THINGS = """hand cream|armchair toy|handbag|hand mixer|hand-held blender|robot arm|clock hand|chicken leg|leg of lamb
head of lettuce|table leg|baby bottle|toy man|cup in hand|phone held by a woman|wooden cutting board|hand sanitizer
hand towel|gingerbread man|hand of bananas|thumb drive|Buddha's hand|shower head|statue of a man|mannequin hand
man figurine|arm rest|palm plant|finger food|face mask|foot pump|legging|armadillo|handle
human skull model|baby carrot"""


@pytest.mark.parametrize("label", PEOPLE.replace("\n", "|").split("|"))
def test_people_and_their_parts_are_no_things(label):
    assert names_person(label)
    found = ruled(thing(label), thing("mug", 600, 600, 700, 700))
    assert singles(found) == ["table", "mug"]
    assert said(found) == [("detections[1]", "person")]


@pytest.mark.parametrize("label", THINGS.replace("\n", "|").split("|"))
def test_things_that_are_named_after_hands_stay(label):
    assert not names_person(label)
    assert singles(ruled(thing(label))) == ["table", label]


def test_a_hand_neither_fills_nor_is_filled():
    held = filled(part("left hand", 100, 400, 300, 600), part("mug", 150, 420, 250, 560))
    found = ruled(composites=[held, filled(BOWL, APPLE, part("fingers", 350, 420, 380, 450))])
    assert singles(found) == ["table", "mug"]
    assert composites(found) == [("bowl", [("apple", 3)])]


# In front of the person.

PERSON = [300, 0, 700, 800]


def test_what_is_behind_a_person_goes_what_is_held_or_beside_stays():
    behind, held = thing("vase", 600, 300, 760, 500), thing("knife", 400, 500, 500, 600, held=True)
    half_behind = thing("jar", 600, 520, 800, 700)
    found = ruled(behind, held, half_behind, people=[PERSON], composites=[filled(BOWL, APPLE)])
    assert singles(found) == ["table", "knife", "jar"]
    assert composites(found) == []
    assert said(found) == [("detections[1]", "behind_person"), ("composites[0].container", "behind_person")]
    assert "62%" in found.remarks[0].detail


def test_people_come_as_plain_boxes_or_objects_and_a_reported_person_stands_for_the_missing_list():
    vase = thing("vase", 400, 300, 500, 500)
    for people in ([PERSON], [{"bbox": PERSON}], [{"bbox_xyxy": PERSON, "label": "person"}]):
        assert singles(ruled(vase, people=people)) == ["table"]
    assert singles(ruled(vase, thing("woman", *PERSON))) == ["table"]
    assert singles(ruled(vase, thing("woman", *PERSON), people=[])) == ["table", "vase"]
    assert singles(ruled(vase, thing("hand", *PERSON))) == ["table", "vase"]
    assert singles(ruled(vase, people=["nobody", None, [1]])) == ["table", "vase"]


def test_a_table_behind_a_person_is_none():
    found = ruled(thing("mug", 10, 600, 60, 700), people=[[0, 0, 1000, 900]])
    assert not found.table
    assert ("detections[0]", "behind_person") in said(found)


# Containers.


@pytest.mark.parametrize("matter", ["coffee", "orange juice", "white rice", "sugar", "whipped cream", "tomato sauce"])
def test_what_holds_anything_that_is_not_solid_is_one_thing(matter):
    found = ruled(composites=[filled(BOWL, APPLE, part(matter, 310, 410, 490, 590))])
    assert singles(found) == ["table", "bowl"]
    assert composites(found) == []
    assert said(found) == [("composites[0].container", "not_solid")]
    assert matter in found.remarks[0].detail


NOT_SOLID = """coffee|Water|rice|brown sugar|pile of sugar|drops of water|ground coffee|black pepper|soup|liquid soap
reflection|lentils|mashed potatoes|milk foam|ketchup|flour|sand|coffee (black)|shadow|grated cheese|salsa dip"""
SOLID = """water bottle|sugar cube|bottle of water|cup of coffee|salt and pepper shakers|hand cream|red pepper
soup spoon|rice cracker|tea bag|coffee beans|liquid soap bottle|powdered sugar donut|ice cubes|cookies|grapes
milk carton|wine glass|rice ball|butter knife|sauce pan|jelly beans|sandwich|object|watermelon
cream cheese bagel|slices of cheese"""


def test_words_for_what_is_solid_and_what_is_not():
    assert [label for label in NOT_SOLID.replace("\n", "|").split("|") if not names_no_solid(label)] == []
    assert [label for label in SOLID.replace("\n", "|").split("|") if names_no_solid(label)] == []


def test_an_empty_container_is_one_thing():
    found = ruled(composites=[filled(BOWL), {"container": part("cup", 600, 600, 700, 700)}])
    assert singles(found) == ["table", "bowl", "cup"]
    assert [rule for _, rule in said(found)] == ["empty_container"] * 2


def test_a_liquid_by_itself_names_its_cup_and_within_one_it_is_no_thing():
    found = ruled(
        thing("coffee", 100, 400, 200, 500), thing("tea", 620, 610, 680, 640), thing("cup", 600, 600, 700, 700)
    )
    assert singles(found) == ["table", "coffee", "cup"]
    assert said(found) == [("detections[2]", "not_solid")]


def test_what_lies_apart_from_its_container_is_no_content():
    found = ruled(composites=[filled(BOWL, APPLE, part("pear", 700, 700, 780, 780))])
    assert singles(found) == ["table", "pear"]
    assert composites(found) == [("bowl", [("apple", 3)])]


def test_contents_of_a_container_that_cannot_be_read_stand_for_themselves():
    found = ruled(thing("fork", 700, 300, 800, 400), composites=[filled({"label": "bowl"}, APPLE)])
    assert singles(found) == ["table", "fork", "apple"]
    assert said(found)[-2:] == [
        ("composites[0].container", "unreadable"),
        ("composites[0].contents[0]", "without_container"),
    ]


# Every thing once.


def test_a_thing_listed_twice_is_one():
    found = ruled(
        thing("mug", 100, 400, 200, 500),
        thing("white cup", 101, 401, 201, 499),
        thing("book", 102, 402, 200, 500),
        thing("mug", 300, 400, 400, 500),
        thing("object", 301, 401, 400, 500),
    )
    assert singles(found) == ["table", "mug", "book", "mug"]
    assert said(found) == [("detections[2]", "duplicate"), ("detections[5]", "duplicate")]


def test_a_container_or_content_that_stands_in_detections_too_stays_in_the_composite():
    bowl, apple = thing("fruit bowl", 301, 400, 500, 601), thing("apple", 330, 420, 400, 501)
    found = ruled(bowl, apple, composites=[filled(BOWL, APPLE)])
    assert singles(found) == ["table"]
    assert composites(found) == [("bowl", [("apple", 3)])]


def test_things_that_the_count_stands_for_are_not_listed_again():
    others = [
        thing("apple", 410, 420, 480, 500),
        thing("green apple", 350, 510, 420, 590),
        thing("apple", 10, 420, 80, 500),
    ]
    found = ruled(*others, composites=[filled(BOWL, APPLE)])
    assert [item.bbox_xyxy for item in found.answer.detections[1:]] == [(10, 420, 80, 500)]
    assert [rule for _, rule in said(found)] == ["counted", "counted"]


def test_two_composites_of_one_container_are_one_and_one_container_within_another_stays_a_container():
    pear = part("pear", 410, 420, 480, 500)
    tray = filled(part("tray", 200, 350, 600, 700), part("bowl", 300, 401, 500, 600))
    found = ruled(composites=[filled(BOWL, APPLE), filled(BOWL, pear), tray])
    assert composites(found) == [("bowl", [("apple", 3), ("pear", 1)])]
    assert singles(found) == ["table", "tray"]
    assert [rule for _, rule in said(found)] == ["duplicate", "duplicate"]


def test_different_things_in_one_place_are_both_kept():
    found = ruled(thing("pizza", 100, 400, 200, 500), thing("plate", 98, 398, 202, 502))
    assert singles(found) == ["table", "pizza", "plate"]


def test_names_that_may_be_one_thing():
    assert same_name("Coffee mugs", "white cup")
    assert same_name("cardboard box", "tea carton")
    assert not same_name("mug", "mug coaster")
    assert not same_name("knife", "fork")


# One box for one thing, and a count.


def test_a_box_around_the_heap_counts_as_one_thing():
    found = ruled(composites=[filled(BOWL, part("apple", 310, 410, 490, 590, count=5))])
    assert composites(found) == [("bowl", [("apple", 1)])]
    assert said(found) == [("composites[0].contents[0]", "group")]
    assert "not 5" in found.remarks[0].detail


@pytest.mark.parametrize(
    ("count", "taken"),
    [(7, 7), ("7", 7), (7.0, 7), (10**400, 1), (5000, 100), ("many", 1), (-2, 1), (None, 1), (True, 1), (2.5, 1)],
)
def test_counts_are_bounded(count, taken):
    found = ruled(composites=[filled(BOWL, part("nut", 330, 420, 350, 440, count=count))])
    assert composites(found) == [("bowl", [("nut", taken)])]
    assert (found.remarks == ()) == (count in (7, "7", 7.0, None))


def test_none_of_something_is_nothing():
    found = ruled(thing("fork"), composites=[filled(BOWL, part("nut", 330, 420, 350, 440, count=0))])
    assert singles(found) == ["table", "fork", "bowl"]


# What cannot be read.


def test_entries_without_label_or_box_are_left_out_one_by_one():
    bad = [{"label": "cup"}, {"bbox_xyxy": [1, 2, 3, 4]}, "mug", thing("fork", 1, 2, 3)]
    good = [thing("spoon", 100 * k, 400, 100 * k + 50, 500) for k in range(4)]
    found = ruled(*bad, *good)
    assert singles(found) == ["table", *["spoon"] * 4]
    assert said(found) == [(f"detections[{k}]", "unreadable") for k in range(1, 5)]
    with pytest.raises(AnswerInvalidError, match=r"most entries.*detections\[4\]: it has no box"):
        ruled(*bad)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{}", "neither"),
        ('{"detections": {"label": "mug"}}', "no list"),
        ('{"detections": [], "composites": "none"}', "no list"),
        (json.dumps({"detections": [TABLE] * (MAX_DETECTIONS + 1)}), "lists 201 things"),
        (json.dumps({"composites": [filled(BOWL, *[APPLE] * 300)]}), "lists 301 things"),
    ],
)
def test_answers_that_are_none(text, message):
    with pytest.raises(AnswerInvalidError, match=message):
        read_answer(text, "xyxy", SENT)


def test_a_score_is_a_number_from_0_to_1():
    scores = [0.4, "0.5", 97, float("nan"), None, "sure"]
    found = ruled(*(thing("fork", 100 * k, 400, 100 * k + 50, 500, score=score) for k, score in enumerate(scores)))
    assert [item.score for item in found.answer.detections[1:]] == [0.4, 0.5, 1.0, 1.0, 1.0, 1.0]
    assert [rule for _, rule in said(found)] == ["score"] * 3


def test_words_for_the_table():
    tables = ["Table", "wooden desk", "coffee table", "work surface", "table top", "kitchen countertop", "countertops"]
    others = ["table lamp", "toy table", "tablecloth", "turntable", "desk fan", "top hat", "table tennis ball"]
    assert [label for label in tables if not names_table(label)] == []
    assert [label for label in others if names_table(label)] == []
