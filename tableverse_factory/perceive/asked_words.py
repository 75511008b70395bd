"""What a detector's label names, by its words: a person, the table, a liquid; and whether two labels name the same.

Labels are English noun phrases, as the prompt asks. The last noun decides ("hand cream" is cream, "water bottle" a
bottle) unless "of" follows ("leg of lamb"), and words before it may say that it is no such thing ("clock hand"). A list
of words cannot know everything: what it does not know stays a thing.
"""

import re
import unicodedata
from dataclasses import dataclass

_CUT = re.compile(r"[(\[{,;:/|]")
_WORD = re.compile(r"[^\W\d_]+")
_MAX_CHARS = 200


def _set(words: str) -> frozenset[str]:
    return frozenset(words.split())


_IRREGULAR = {
    "people": "person",
    "men": "man",
    "women": "woman",
    "children": "child",
    "feet": "foot",
    "gentlemen": "gentleman",
    "knives": "knife",
    "loaves": "loaf",
    "halves": "half",
    "shelves": "shelf",
    "leaves": "leaf",
    "mice": "mouse",
    "glasses": "glasses",
    "scissors": "scissors",
}
_ENDS_PHRASE = _set(
    "with in on at near by from for to under over behind beside inside holding wearing containing full filled that"
)
_DOES = _set(
    "reaching touching using gripping grabbing grasping pouring cutting chopping slicing peeling stirring picking "
    "placing pointing resting pressing typing eating drinking"
)
"""What people and their hands do: "hand cutting bread" is a hand, though "wooden cutting board" is a board."""
_TRAILING = _set("left right visible partial partially only held")
_SMALL = _set("a an the some one two three both its his her their my your")

_PERSON = _set(
    "person human man woman boy girl child kid baby toddler infant adult teenager lady gentleman guy chef waiter "
    "waitress barista crowd"
)
_LIMB = _set("hand arm forearm elbow wrist finger fingertip fingernail thumb fist knuckle shoulder torso")
_BODY = _set("head face leg foot neck hair body skin palm lap knee thigh ear eye nose mouth toe ankle chin beard chest")
"""Words that name more than parts of people: they count where they stand alone or say whose they are."""
_OF_A_PERSON = _PERSON | _SMALL | _set("left right bare upper lower other visible open male female s")
_NOT_HUMAN = _set(
    "toy doll dollhouse robot robotic mechanical mannequin figurine statue sculpture model puppet lego plastic wooden "
    "rubber ceramic gingerbread snow chocolate candy paper cardboard plush stuffed clay stone bronze prosthetic "
    "miniature clock watch hour minute second chair sofa lamp table desk monitor microphone mic tripod tone boom swing "
    "lever crane chicken turkey lamb pork duck frog crab fish bear buddha"
)

_TABLE = _set("table desk countertop counter tabletop worktop workbench surface")
_NO_TABLE = _set("toy doll dollhouse miniature model tally step coin lego")

_FLUID = _set(
    "liquid fluid water coffee tea milk juice soda cola lemonade beer wine whisky vodka sake espresso latte cappuccino "
    "cocoa smoothie milkshake beverage drink broth soup stew curry oil vinegar syrup honey cream sauce ketchup mustard "
    "mayonnaise mayo dip dressing gravy salsa guacamole hummus jam jelly paste puree custard yogurt yoghurt pudding "
    "porridge oatmeal batter foam froth lather ink paint"
)
_GRAINS = _set(
    "powder flour sugar salt rice sand soil dirt dust cereal granola oat muesli lentil quinoa couscous bulgur spice "
    "cinnamon paprika turmeric seed sprinkle crumb breadcrumb grain starch cornmeal granule gravel ash noodle "
    "spaghetti ramen pasta salad slaw confetti glitter"
)
_NO_MATTER = _set(
    "reflection glare highlight shadow steam smoke vapor bubble air emptiness nothing content stuff material "
    "substance matter mixture residue stain ice food"
)
_NOT_SOLID = _FLUID | _GRAINS | _NO_MATTER
_AMOUNT = _set(
    "pile heap drop droplet layer pool puddle splash spoonful handful amount serving portion scoop dollop bit trace "
    "mound swirl bed remnant rest lot"
)
_OF_COSMETICS = _set("hand face body sun shaving eye foot skin baby")
_LOOSENED = _set("liquid melted ground powdered grated shredded mashed whipped granulated foamy scrambled minced")

_SYNONYMS = tuple(
    map(
        _set,
        (
            "cup mug teacup tumbler beaker glass",
            "bowl dish basin",
            "plate dish saucer platter",
            "bottle flask",
            "box carton package packet case",
            "can tin",
            "jar pot canister",
            "pan skillet pot saucepan",
            "phone smartphone cellphone mobile telephone",
            "laptop notebook computer",
            "book notebook novel",
            "remote control controller",
            "pen marker pencil",
            "tray board platter",
            "basket bin",
            "cloth towel napkin rag tissue",
            "tissue kleenex",
            "ball sphere",
            "block cube brick",
            "glasses eyeglasses spectacles",
        ),
    )
)


_ANYTHING = _set("object thing item")


@dataclass(frozen=True, slots=True)
class _Phrase:
    """A label taken apart: the noun that decides, the words before it, and the words after "of"."""

    head: str
    before: tuple[str, ...]
    of: tuple[str, ...]


def names_person(label: str) -> bool:
    """Whether the label, or one of two that "and" joins, names a person or a part of a body."""
    return any(_is_person(_phrase(part, _ENDS_PHRASE | _DOES)) for part in label[:_MAX_CHARS].split(" and "))


def _is_person(phrase: _Phrase) -> bool:
    if _NOT_HUMAN & set(phrase.before):
        return False
    if phrase.head == "part" and phrase.before[-1:] == ("body",):
        return True
    whose = set(phrase.of) - _SMALL
    if whose and not whose & _OF_A_PERSON and phrase.head not in _PERSON:
        return False
    if phrase.head in _PERSON or phrase.head in _LIMB:
        return True
    return phrase.head in _BODY and set(phrase.before) <= _OF_A_PERSON


def names_whole_person(label: str) -> bool:
    """Whether the label names a person, not only a part of one."""
    parts = (_phrase(part, _ENDS_PHRASE | _DOES) for part in label[:_MAX_CHARS].split(" and "))
    return any(_is_person(phrase) and phrase.head in _PERSON for phrase in parts)


def names_table(label: str) -> bool:
    """Whether the label names what everything stands on."""
    phrase = _phrase(label)
    is_top = phrase.head == "top" and phrase.before[-1:] in {("table",), ("desk",), ("counter",)}
    return (phrase.head in _TABLE or is_top) and not _NO_TABLE & set(phrase.before)


def names_no_solid(label: str) -> bool:
    """Whether the label names a liquid, a sauce, a foam, a powder, grains, or nothing that has a shape of its own."""
    phrase = _phrase(label)
    if phrase.head in _AMOUNT and phrase.of:
        return phrase.of[-1] in _NOT_SOLID
    if phrase.head == "pepper":  # else it is a vegetable
        return bool({"black", "white", "ground", "cracked"} & set(phrase.before))
    if phrase.head == "cream" and _OF_COSMETICS & set(phrase.before):  # it comes in a tube
        return False
    return phrase.head in _NOT_SOLID or bool(_LOOSENED & set(phrase.before[-1:]))


def same_name(a: str, b: str) -> bool:
    """Whether two labels may name one thing: the same last noun, or one that is used for the same."""
    one, other = _phrase(a).head, _phrase(b).head
    if one == other or {one, other} & _ANYTHING:
        return True
    return any(one in words and other in words for words in _SYNONYMS)


def _phrase(label: str, ends: frozenset[str] = _ENDS_PHRASE) -> _Phrase:
    text = unicodedata.normalize("NFKC", label[:_MAX_CHARS]).casefold().replace("'s", "").replace("’s", "")
    cut = _CUT.split(text.lstrip(" ([{,;:/|"))[0]
    words = [_singular(word) for word in _WORD.findall(cut)]
    end = next((k for k, word in enumerate(words) if k > 0 and word in ends), len(words))
    words = words[:end]
    of = words.index("of") if "of" in words[1:] else len(words)
    noun, after = words[:of], words[of + 1 :]
    while len(noun) > 1 and noun[-1] in _TRAILING:
        noun.pop()
    return _Phrase(noun[-1], tuple(noun[:-1]), tuple(after)) if noun else _Phrase("object", (), ())


def _singular(word: str) -> str:
    if word in _IRREGULAR:
        return _IRREGULAR[word]
    if len(word) > 4 and word.endswith("ies"):
        return f"{word[:-3]}y"
    if len(word) > 4 and word.endswith(("ches", "shes", "xes", "sses", "oes")):
        return word[:-2]
    return word[:-1] if len(word) > 3 and word.endswith("s") and not word.endswith(("ss", "us", "is")) else word
