"""What a model says, read and held to the rules of appendix A: each rule by what would hurt without it."""

import json

import pytest

from schemas.detection import MAX_DETECTIONS
from tableverse_factory.core.errors import AnswerInvalidError
from tableverse_factory.stages.perceive.vlm.label_lexicon import (
    may_name_table,
    may_share_name,
    names_person,
    names_table,
)
from tableverse_factory.stages.perceive.vlm.non_solid_labels import fills, names_non_solid
from tableverse_factory.stages.perceive.vlm.parse_answer import parse_detections
from tableverse_factory.stages.perceive.vlm.postprocess import NO_TABLE, AnswerByRules, apply_rules

SENT = (1536, 1152)
TABLE = {"label": "table", "bbox_xyxy": [0, 300, 1000, 1000]}


def ruled(*things, composites=(), table=TABLE, **more) -> AnswerByRules:
    listed = [*([table] if table else []), *things]
    text = json.dumps({"detections": listed, "composites": list(composites), **more})
    return apply_rules(parse_detections(text, "xyxy", SENT))


def thing(label, *box, **more):
    return {"label": label, "bbox_xyxy": list(box or (100, 400, 200, 500)), **more}


def part(label, *box, **more):
    return {"label": label, "bbox": list(box), **more}


def filled(container, *contents):
    return {"type": "container_fill", "description": "", "container": container, "contents": list(contents)}


def singles(found: AnswerByRules) -> list[str]:
    return [item.label for item in found[0].detections]


def composites(found: AnswerByRules) -> list[tuple[str, list[tuple[str, int]]]]:
    return [(c.container.label, [(inside.label, inside.count) for inside in c.contents]) for c in found[0].composites]


def said(found: AnswerByRules) -> list[tuple[str, str]]:
    return [(remark.where, remark.rule) for remark in found[1]]


BOWL = part("bowl", 300, 400, 500, 600)
APPLE = part("apple", 330, 420, 400, 500, count=3)


def test_an_answer_that_keeps_the_rules_comes_through_as_it_is():
    spoon = thing("spoon", 700, 500, 800, 560, score=0.7, description="a steel\nspoon")
    found = ruled(spoon, composites=[filled(BOWL, APPLE)], people=[])
    assert singles(found)[0] == "table"
    assert found[1] == ()
    assert singles(found) == ["table", "spoon"]
    assert found[0].detections[1].bbox_xyxy == (700, 500, 800, 560)
    assert (found[0].detections[1].score, found[0].detections[1].description) == (0.7, "a steel spoon")
    assert composites(found) == [("bowl", [("apple", 3)])]


# One table.


def test_several_tables_are_one_the_one_that_is_labelled_so_else_the_largest():
    desk, wooden, mug = thing("desk", 0, 350, 300, 600), thing("wooden table", 0, 200, 1000, 1000), thing("mug")
    found = ruled(desk, wooden, mug, table=None)
    assert singles(found) == ["table", "mug"]
    assert found[0].detections[0].bbox_xyxy == (0, 200, 1000, 1000)
    assert said(found) == [("detections[0]", "second_table")]
    found = ruled(desk, wooden, thing("Table", 0, 700, 900, 1000), mug, thing("table", 0, 280, 1000, 1000))
    assert singles(found) == ["table", "mug"]
    assert found[0].detections[0].bbox_xyxy == (0, 280, 1000, 1000)
    assert [rule for _, rule in said(found)] == ["second_table"] * 4


MAY_BE_A_TABLE = "Surface|cutting surface|pool table|white counter|Geiger counter|lap desk|click counter"


@pytest.mark.parametrize("label", MAY_BE_A_TABLE.split("|"))
def test_what_may_be_something_else_is_no_second_table(label):
    assert singles(ruled(thing(label, 0, 0, 1000, 900))) == ["table", label]


def test_what_may_be_something_else_is_the_table_where_no_other_is():
    surface, mug = thing("Surface", 0, 200, 1000, 1000), thing("mug")
    found = ruled(surface, mug, thing("white counter", 500, 500, 540, 540), table=None)
    assert singles(found) == ["table", "mug", "white counter"]
    for device in ("Geiger counter", "people counter", "toy table", "table of contents"):
        with pytest.raises(AnswerInvalidError, match="labelled 'table'"):
            ruled(thing(device, 0, 200, 1000, 1000), mug, table=None)


def test_without_a_table_the_model_is_told_so_unless_it_sees_nothing_at_all():
    with pytest.raises(AnswerInvalidError, match="labelled 'table'") as error:
        ruled(thing("mug"), table=None)
    assert error.value.reason == NO_TABLE
    assert not singles(ruled(table=None))


def test_a_table_contains_nothing():
    on_it = filled(part("dining table", 0, 300, 1000, 1000), part("mug", 100, 400, 200, 500))
    found = ruled(table=None, composites=[on_it])
    assert singles(found) == ["table", "mug"]
    assert composites(found) == []


# Nobody's hand.

PEOPLE = """hand|hands|Left hand|person's hand|human arm|forearms|hand holding a cup|man in a red shirt|two people
hand_2|hand (left)|fingers|a woman’s hand|hand of a child|hand cutting bread|woman and child|body part|bare feet|face
ｈａｎｄ|child's fingertips|hand and cup|baby|men|HANDS|right elbow|person 1|wrist with watch|head of a man|chef
pair of hands|human fingers|person's arm|woman|gloved hand|a group of people|back of a hand
palm of a hand|thumb and index finger|left and right hands|tips of fingers|old woman
hand and arm|right palm|someone's arm|part of a person|tattooed arm|baker's hands|young man|two hands|left arm and hand
man|arms|hand reaching for a cup|person's left hand|upper body|bearded man
fingers of a hand|blue gloved hand|person standing"""
THINGS = """hand cream|armchair toy|handbag|hand mixer|hand-held blender|robot arm|clock hand|chicken leg|leg of lamb
head of lettuce|table leg|baby bottle|toy man|cup in hand|phone held by a woman|wooden cutting board|hand sanitizer
hand towel|gingerbread man|hand of bananas|thumb drive|Buddha's hand|shower head|statue of a man|mannequin hand
man figurine|arm rest|palm plant|finger food|face mask|foot pump|legging|armadillo|handle
human skull model|baby carrot|gripper fingers|Allegro hand|PVC elbow|brass knuckles|action man|cheese finger
beef shoulder|record player arm|marble torso|foosball man|Shadow hand|lady fingers|suction arm|skeleton hand|metal arm
ham knuckle|monitor arm|prosthesis hand|camera arm|wise man|bobblehead kid|Game Boy|robot arm and hand
gripper and fingers|hand of a robot|pair of robot hands|palm|chest|chest of drawers|tactile finger
group of chess men
fingers of a robot hand|blue hand"""


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
    places = ["detections[1]", "composites[0].container", "composites[0].contents[0]"]
    assert said(found) == [(place, "behind_person") for place in places]
    assert "62%" in found[1][0].detail


def test_what_lies_in_a_container_behind_a_person_may_be_held_or_in_front():
    basket = part("basket", 500, 400, 800, 600)
    knife, pear = part("knife", 540, 420, 600, 500, held=True), part("pear", 690, 420, 790, 500)
    found = ruled(people=[PERSON], composites=[filled(basket, part("apple", 510, 420, 600, 500), knife, pear)])
    assert singles(found) == ["table", "knife", "pear"]
    assert said(found) == [(f"composites[0].{name}", "behind_person") for name in ("container", "contents[0]")]


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
    assert "table" not in singles(found)
    assert ("detections[0]", "behind_person") in said(found)


# Containers.


@pytest.mark.parametrize("matter", ["coffee", "orange juice", "white rice", "sugar", "whipped cream", "tomato sauce"])
def test_what_holds_anything_that_is_not_solid_is_one_thing(matter):
    found = ruled(composites=[filled(BOWL, APPLE, part(matter, 310, 410, 490, 590))])
    assert singles(found) == ["table", "bowl"]
    assert composites(found) == []
    places = ["composites[0].container", "composites[0].contents[0]", "composites[0].contents[1]"]
    assert said(found) == [(place, "not_solid") for place in places], "a row for everything that goes"
    assert matter in found[1][0].detail


@pytest.mark.parametrize("drink", ["soda", "milk", "hot sauce", "wine"])
def test_a_liquid_in_what_holds_none_names_its_bottle(drink):
    basket = part("basket", 300, 400, 500, 600)
    found = ruled(composites=[filled(basket, part("apple", 330, 420, 400, 500), part(drink, 410, 420, 480, 500))])
    assert composites(found) == [("basket", [("apple", 1), (drink, 1)])]
    assert found[1] == ()


def test_what_stands_on_a_tray_or_laptop_is_not_its_filling():
    on_it = [
        thing(label, 400 + 60 * k, 500, 450 + 60 * k, 600)
        for k, label in enumerate(["canned food", "powdered doughnut", "coffee", "cup noodles"])
    ]
    names = [item["label"] for item in on_it]
    for holder in ("tray", "laptop", "napkin"):
        assert singles(ruled(thing(holder, 300, 400, 800, 800), *on_it)) == ["table", holder, *names]
    in_a_bowl = ruled(thing("bowl", 300, 400, 800, 800), *on_it)
    assert singles(in_a_bowl) == ["table", "bowl", "canned food", "powdered doughnut", "cup noodles"]


def test_what_fills_what():
    yes = ["coffee, mug", "rice, bowl", "ketchup, plate", "cereal, box", "shadow, laptop", "pile of sugar, plate"]
    no = ["coffee, saucer", "milk, box", "salt, caddy", "mug, bowl", "soup, tray", "water, book", "cup noodles, bowl"]
    assert [pair for pair in yes if not fills(*pair.split(", "), is_listed_in_it=False)] == []
    assert [pair for pair in no if fills(*pair.split(", "), is_listed_in_it=False)] == []
    assert fills("coffee", "thing", is_listed_in_it=True)
    assert not fills("coffee", "thing", is_listed_in_it=False)


NOT_SOLID = """coffee|Water|rice|brown sugar|pile of sugar|drops of water|ground coffee|black pepper|soup|liquid soap
reflection|lentils|mashed potatoes|milk foam|ketchup|flour|sand|coffee (black)|shadow|grated cheese|salsa dip"""
SOLID = """water bottle|sugar cube|bottle of water|cup of coffee|salt and pepper shakers|hand cream|red pepper
soup spoon|rice cracker|tea bag|coffee beans|liquid soap bottle|powdered sugar donut|ice cubes|cookies|grapes
milk carton|wine glass|rice ball|butter knife|sauce pan|jelly beans|sandwich|object|watermelon
cream cheese bagel|slices of cheese|canned food|powdered doughnut|cup noodles|liquid dispenser
liquid container|melted crayon|shredded wheat|liquid glue|instant noodles|bottled water|scrambled cube"""


def test_words_for_what_is_solid_and_what_is_not():
    assert [label for label in NOT_SOLID.replace("\n", "|").split("|") if not names_non_solid(label)] == []
    assert [label for label in SOLID.replace("\n", "|").split("|") if names_non_solid(label)] == []


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


def test_contents_that_are_no_list_are_one_or_a_row():
    found = ruled({"label": "fork"}, thing("fork"), composites=[{"container": BOWL, "contents": APPLE}])
    assert composites(found) == [("bowl", [("apple", 3)])]
    found = ruled(thing("fork"), composites=[{"container": BOWL, "contents": "apples"}])
    assert ("composites[0].contents[0]", "unreadable") in said(found)


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
    assert [item.bbox_xyxy for item in found[0].detections[1:]] == [(10, 420, 80, 500)]
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
    assert may_share_name("Coffee mugs", "white cup")
    assert may_share_name("cardboard box", "tea carton")
    assert not may_share_name("mug", "mug coaster")
    assert not may_share_name("knife", "fork")


# One box for one thing, and a count.


def test_a_box_around_the_heap_counts_as_one_thing():
    found = ruled(composites=[filled(BOWL, part("apple", 310, 410, 490, 590, count=5))])
    assert composites(found) == [("bowl", [("apple", 1)])]
    assert said(found) == [("composites[0].contents[0]", "group")]
    assert "not 5" in found[1][0].detail


@pytest.mark.parametrize(
    ("count", "taken"),
    [(7, 7), ("7", 7), (7.0, 7), (10**400, 1), (5000, 100), ("many", 1), (-2, 1), (None, 1), (True, 1), (2.5, 1)],
)
def test_counts_are_bounded(count, taken):
    found = ruled(composites=[filled(BOWL, part("nut", 330, 420, 350, 440, count=count))])
    assert composites(found) == [("bowl", [("nut", taken)])]
    assert (found[1] == ()) == (count in (7, "7", 7.0, None))


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
        parse_detections(text, "xyxy", SENT)


def test_a_score_is_a_number_from_0_to_1():
    scores = [0.4, "0.5", 97, float("nan"), None, "sure"]
    found = ruled(*(thing("fork", 100 * k, 400, 100 * k + 50, 500, score=score) for k, score in enumerate(scores)))
    assert [item.score for item in found[0].detections[1:]] == [0.4, 0.5, 1.0, 1.0, 1.0, 1.0]
    assert [rule for _, rule in said(found)] == ["score"] * 3


def test_words_for_the_table():
    tables = ["Table", "wooden desk", "coffee table", "work surface", "table top", "kitchen countertop", "countertops"]
    tables += ["white table", "surface of the table", "top of a wooden desk", "large round table", "kitchen counter"]
    others = ["table lamp", "toy table", "tablecloth", "turntable", "desk fan", "top hat", "table tennis ball"]
    assert [label for label in others if may_name_table(label)] == []
    assert [label for label in tables if not names_table(label)] == []
    assert [label for label in others if names_table(label)] == []
