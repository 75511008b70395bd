"""Classification of a detector's label by its words: person, table or object; and whether two labels are synonyms.

Labels are English noun phrases, as the prompt asks. The last noun decides ("hand cream" is cream, "water bottle" a
bottle) unless "of" follows ("leg of lamb"). Losing an object is worse than keeping a wrong one: a label excludes only
where every word before the noun leaves no other reading ("left hand", but not "Allegro hand").
"""

import re
import unicodedata
from dataclasses import dataclass, replace

from tableverse_factory.core.text import to_singular

_CUT = re.compile(r"[(\[{,;:/|]")
_WORD = re.compile(r"[^\W\d_]+")
_MAX_CHARS = 200


def split_words(words: str) -> frozenset[str]:
    """Split a text into a set of words."""
    return frozenset(words.split())


_ENDS_PHRASE = split_words(
    "with in on at near by from for to under over behind beside inside holding wearing containing full filled that"
)
# Of people and hands: "hand cutting bread" is a hand, though "wooden cutting board" is a board
_ACTIONS = split_words(
    "reaching touching using gripping grabbing grasping pouring cutting chopping slicing peeling stirring picking "
    "placing pointing resting pressing typing eating drinking standing sitting smiling leaning looking"
)
_TRAILING = split_words("left right visible partial partially only held")
_DETERMINERS = split_words("a an the some one two three both its his her their my your")

_PERSON = split_words(
    "person human man woman boy girl child kid baby toddler infant adult teenager lady gentleman guy chef waiter "
    "waitress barista crowd"
)
_LIMB = split_words("hand arm forearm elbow wrist finger fingertip fingernail thumb fist knuckle shoulder torso")
_BODY = split_words("head face leg foot neck hair body skin lap knee thigh ear eye nose mouth toe ankle chin beard")
_AMBIGUOUS_PARTS = split_words("palm chest")  # parts of people only where an owner is named
_OWNER = _PERSON | split_words(
    "someone somebody user worker operator cook baker customer mother father student surgeon nurse"
)
_POSSESSIVES = _OWNER | split_words("bare left right")
_OF_A_PERSON = (
    _POSSESSIVES
    | _DETERMINERS
    | split_words("upper lower other another open male female s three four several many multiple")
)
_OF_A_LIMB = split_words(
    "gloved skinned tattooed hairy sleeved outstretched extended raised clenched closed bent pointing reaching holding "
    "blurred pale wrinkled wet dirty young old elderly long short small large first index middle ring little pinky"
)
_COVERED = split_words("gloved sleeved skinned")  # beside which any colour may stand: "blue gloved hand"
# Adjectives of living people; a "foosball man" is none
_PERSON_ADJECTIVES = split_words(
    "young old elderly tall short bearded bald blond blonde black white brown asian african indian smiling laughing "
    "standing sitting seated kneeling walking masked blurred background business police"
)
_ARTIFICIAL = split_words(
    "robot robotic gripper effector manipulator mannequin doll statue figurine skeleton prosthetic toy"
)
_NO_LIMB = {("lady", "finger")}
# Parts and amounts of what "of" names: "pair of hands"
_PARTITIVES = split_words("part pair group couple back tip side portion section piece top close palm bunch")

_TABLE = split_words("table desk countertop counter tabletop worktop workbench surface")
_TABLE_PLACES = split_words(
    "kitchen dining coffee breakfast bar cafe restaurant shop store reception checkout service office work working "
    "study computer writing lab laboratory bathroom vanity school conference meeting picnic patio garden side end "
    "main bedside marble granite quartz stone concrete tile tiled laminate stainless steel wood wooden oak pine "
    "walnut bamboo"
)
# Adjectives of tables, though not of counters: a "red counter" is a piece of a game
_TABLE_ADJECTIVES = split_words(
    "white black gray grey brown beige tan blue green red yellow light dark colored round square rectangular circular "
    "oval flat long short small large big low high standing folding glass metal plastic polished shiny clean empty "
    "cluttered visible outdoor textured smooth"
)
_NOT_TABLES = split_words(
    "toy doll dollhouse miniature model tally step coin geiger click person hand bead lap periodic frequency"
)

_SYNONYM_GROUPS = (
    "cup mug teacup tumbler beaker glass;bowl dish basin;plate dish saucer platter;bottle flask;"
    "box carton package packet case;can tin;jar pot canister;pan skillet pot saucepan;"
    "phone smartphone cellphone mobile telephone;laptop notebook computer;book notebook novel;"
    "remote control controller;pen marker pencil;tray board platter;basket bin;"
    "cloth towel napkin rag tissue;ball sphere;block cube brick;glasses eyeglasses spectacles"
)
_SYNONYMS = tuple(map(split_words, _SYNONYM_GROUPS.split(";")))
_GENERIC = split_words("object thing item")


@dataclass(frozen=True, slots=True)
class LabelPhrase:
    """A parsed label: the noun that decides, the words before it, and the words after "of"."""

    head: str
    before: tuple[str, ...]
    of: tuple[str, ...]


def names_person(label: str) -> bool:
    """Whether the label, or one of two that "and" joins, names a person or a part of a body."""
    return any(_is_person(phrase) for phrase in _split_conjunction(label))


def names_whole_person(label: str) -> bool:
    """Whether the label names a person, not only a part of one."""
    return any(_is_person(phrase) and _resolve_amount(phrase).head in _PERSON for phrase in _split_conjunction(label))


def _split_conjunction(label: str) -> list[LabelPhrase]:
    """Parse the phrases that "and" joins; a bare noun takes "robot", "toy" and the like from the first."""
    first, *others = (parse_label(part, _ENDS_PHRASE | _ACTIONS) for part in label[:_MAX_CHARS].split(" and "))
    made = tuple(word for word in (*first.before, first.head) if word in _ARTIFICIAL)
    return [first, *(phrase if phrase.before else replace(phrase, before=made) for phrase in others)]


def _resolve_amount(phrase: LabelPhrase) -> LabelPhrase:
    """Parse what "of" names where the noun is an amount or a part."""
    whole = tuple(word for word in phrase.of if word not in _DETERMINERS)
    return LabelPhrase(whole[-1], whole[:-1], ()) if phrase.head in _PARTITIVES and whole else phrase


def _is_person(phrase: LabelPhrase) -> bool:
    if phrase.head == "part" and phrase.before[-1:] == ("body",):
        return True
    phrase = _resolve_amount(phrase)
    before = set(phrase.before)
    if phrase.head in _PERSON:
        return before <= _OF_A_PERSON | _PERSON_ADJECTIVES
    whole = tuple(word for word in phrase.of if word not in _DETERMINERS)
    if whole and whole[-1] in _LIMB:  # "fingers of a hand"
        return _is_person(LabelPhrase(whole[-1], whole[:-1], ()))
    if whole and not _OWNER & set(whole):  # "leg of lamb"
        return False
    if phrase.head in _LIMB:
        known = _OF_A_PERSON | _OF_A_LIMB | (_TABLE_ADJECTIVES if before & _COVERED else frozenset())
        return before <= known and (*phrase.before[-1:], phrase.head) not in _NO_LIMB
    if phrase.head in _AMBIGUOUS_PARTS:
        return before <= _OF_A_PERSON and bool(before & _POSSESSIVES or phrase.of)
    return phrase.head in _BODY and before <= _OF_A_PERSON


def names_table_exactly(label: str) -> bool:
    """Whether the label is exactly "table", as the prompt asks."""
    phrase = parse_label(label)
    return phrase.head == "table" and not phrase.before and not phrase.of


def names_table(label: str) -> bool:
    """Whether the label names the table and can name nothing else."""
    phrase = _parse_table_phrase(label)
    if phrase is None or (phrase.head == "surface" and not phrase.before):
        return False
    adjectives = frozenset() if phrase.head == "counter" else _TABLE_ADJECTIVES
    return set(phrase.before) <= _DETERMINERS | _TABLE_PLACES | adjectives


def may_name_table(label: str) -> bool:
    """Whether the label names the table where no other label does."""
    phrase = _parse_table_phrase(label)
    return phrase is not None and not _NOT_TABLES & set(phrase.before)


def _parse_table_phrase(label: str) -> LabelPhrase | None:
    """Parse the noun for a table and the words before it; None where there is no such noun."""
    phrase = parse_label(label)
    of = tuple(word for word in phrase.of if word not in _DETERMINERS)
    if of and phrase.head in _PARTITIVES | {"surface"}:
        phrase = LabelPhrase(of[-1], of[:-1], ())
    elif of and not set(of) <= _TABLE_PLACES | _TABLE_ADJECTIVES:  # "table of contents"
        return None
    if phrase.head == "top" and phrase.before[-1:] in {("table",), ("desk",), ("counter",)}:
        return LabelPhrase("tabletop", phrase.before[:-1], ())
    return phrase if phrase.head in _TABLE else None


def may_share_name(a: str, b: str) -> bool:
    """Whether two labels may name one object: the same last noun, or synonyms."""
    one, other = parse_label(a).head, parse_label(b).head
    if one == other or {one, other} & _GENERIC:
        return True
    return any(one in words and other in words for words in _SYNONYMS)


def parse_label(label: str, ends: frozenset[str] = _ENDS_PHRASE) -> LabelPhrase:
    """Parse a label up to the first of the words that end it; its words become lower case and singular."""
    text = unicodedata.normalize("NFKC", label[:_MAX_CHARS]).casefold().replace("'s", "").replace("’s", "")
    cut = _CUT.split(text.lstrip(" ([{,;:/|"))[0]
    words = [to_singular(word) for word in _WORD.findall(cut)]
    words = words[: next((k for k, word in enumerate(words) if k > 0 and word in ends), None)]
    of = words.index("of") if "of" in words[1:] else len(words)
    noun, after = words[:of], words[of + 1 :]
    while len(noun) > 1 and noun[-1] in _TRAILING:
        noun.pop()
    return LabelPhrase(noun[-1], tuple(noun[:-1]), tuple(after)) if noun else LabelPhrase("object", (), ())
