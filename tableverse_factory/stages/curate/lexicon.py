"""What words say about things: kinds, hinges, sizes, and what goes where in daily life. Labels are untrusted text.

The head noun decides: a `dog bowl` is a bowl, a `mug with a cat` is a mug, a `toy car` is a toy.
"""

import re
from functools import lru_cache

GENERIC = frozenset({"object", "thing", "item", "unknown"})

COLORS = ("black", "white", "grey", "brown", "red", "orange", "yellow", "green", "blue", "purple", "pink")

KINDS: dict[str, frozenset[str]] = {
    kind: frozenset(words.split())
    for kind, words in {
        "drinkware": "mug cup glass tumbler wineglass goblet teacup",
        "dish": "plate saucer dish platter board coaster placemat",
        "bowl": "bowl ramekin basin colander strainer",
        "cookware": "pan frypan pot wok saucepan skillet casserole",
        "storage": "basket tray bin bucket pail crate container trashcan holder organizer drawer vase planter case "
        "pencilcase",
        "cutlery": "fork knife spoon chopstick chopsticks ladle spatula whisk tongs peeler dipper opener grater",
        "food": "apple banana orange lemon lime pear peach plum strawberry tomato potato onion carrot pepper fruit "
        "vegetable avocado mango grape cucumber egg cheese meat melon pineapple kiwi bread bun croissant cake cookie "
        "biscuit chip chips donut muffin sandwich pizza broccoli mushroom corn garlic cherry grapes",
        "packaged": "can tin bottle carton box package packet bag pouch jar ketchup mustard sauce milk juice soda "
        "cereal pitcher jug teapot kettle",
        "toiletry": "shampoo soap lotion toothpaste toothbrush detergent sanitizer cream razor deodorant sponge",
        "tool": "hammer wrench screwdriver pliers clamp drill padlock lock flashlight tape nail screw bolt nut",
        "office": "stapler pen pencil marker eraser notebook book scissors magazine envelope ruler glue card",
        "device": "phone remote camera mouse keyboard laptop tablet clock watch speaker charger calculator headphones",
        "toy": "toy ball puzzle block blocks lego doll figurine plush cube dice car",
    }.items()
}
"""Kinds of table-top things, by head noun."""

CONTENTS: dict[str, frozenset[str]] = {
    container: frozenset(kinds.split())
    for container, kinds in {
        "drinkware": "cutlery food office",
        "bowl": "food packaged cutlery toy drinkware bowl",
        "cookware": "food cutlery",
        "storage": "drinkware dish bowl cutlery food packaged toiletry tool office device toy unknown",
        "packaged": "food cutlery office toy tool unknown",
        "unknown": "food packaged cutlery toiletry tool office device toy unknown",
    }.items()
}
"""What people put into a container of a kind."""

CARRIES: dict[str, frozenset[str]] = {
    support: frozenset(kinds.split())
    for support, kinds in {
        "dish": "food drinkware bowl cutlery packaged dish",
        "storage": "drinkware dish bowl cutlery food packaged toiletry tool office device toy unknown",
        "packaged": "packaged toy office",
        "office": "drinkware packaged office toy device unknown",
        "toy": "toy",
        "unknown": "drinkware dish bowl packaged toiletry tool office device toy unknown",
    }.items()
}
"""What people put on top of a thing of a kind."""

_LIVING_OR_LARGE = (
    "person man woman child boy girl baby people human face hand arm leg foot finger head body "
    "dog cat bird horse cow rabbit hamster fish turtle snake "
    "refrigerator fridge freezer oven stove dishwasher microwave washer dryer sofa couch bed chair armchair "
    "bookshelf wardrobe cabinet bathtub toilet sink door window bicycle motorcycle truck bus tree car"
)
NON_TABLETOP = frozenset(_LIVING_OR_LARGE.split())

_SMALL_AND_DEAD = (
    "toy figurine statue model miniature plush doll stuffed plastic lego picture photo sculpture ornament hot"
)
_STAND_INS = frozenset(_SMALL_AND_DEAD.split())
"""Words that turn a living or huge thing into a small dead one."""

SIZES_M: tuple[tuple[frozenset[str], float, float], ...] = tuple(
    (frozenset(words.split()), smallest, largest)
    for words, smallest, largest in (
        ("mug cup teacup tumbler", 0.05, 0.20),
        ("bowl ramekin", 0.05, 0.45),
        ("plate saucer", 0.08, 0.45),
        ("bottle", 0.05, 0.50),
        ("can tin", 0.04, 0.35),
        ("spoon fork knife", 0.08, 0.45),
        ("apple orange lemon lime pear peach plum kiwi egg tomato", 0.02, 0.16),
        ("banana", 0.07, 0.30),
        ("strawberry cherry grape nut", 0.008, 0.08),
        ("laptop", 0.20, 0.60),
        ("phone", 0.08, 0.25),
        ("book magazine notebook", 0.07, 0.50),
        ("scissors pliers", 0.06, 0.45),
        ("pen pencil marker", 0.06, 0.30),
        ("keyboard", 0.15, 0.60),
        ("mouse", 0.05, 0.20),
        ("coin key dice", 0.008, 0.12),
    )
)
"""Longest dimension of a thing, smallest and largest [m]."""

_HINGED: tuple[tuple[frozenset[str], str], ...] = (
    (frozenset({"laptop"}), "Laptop"),
    (frozenset({"scissors", "shears"}), "Scissors"),
    (frozenset({"pliers", "tongs", "clamp", "nippers"}), "Pliers"),
    (frozenset({"trashcan", "wastebasket", "dustbin"}), "TrashCan"),
    (frozenset({"bucket", "pail"}), "Bucket"),
    (frozenset({"shampoo", "mustard", "ketchup", "lotion", "detergent", "sanitizer"}), "Bottle"),
    (frozenset({"lunchbox", "toolbox", "briefcase", "suitcase"}), "Box"),
)

_HINGED_PAIRS = (
    (frozenset({"trash", "can"}), "TrashCan"),
    (frozenset({"garbage", "can"}), "TrashCan"),
    (frozenset({"lunch", "box"}), "Box"),
    (frozenset({"tool", "box"}), "Box"),
    (frozenset({"jewelry", "box"}), "Box"),
    (frozenset({"pizza", "box"}), "Box"),
)

_SYNONYMS = (
    frozenset({"mug", "cup", "teacup"}),
    frozenset({"can", "tin"}),
    frozenset({"box", "carton", "package", "packet"}),
    frozenset({"plate", "dish", "saucer", "platter"}),
    frozenset({"bowl", "ramekin", "basin"}),
    frozenset({"pan", "frypan", "skillet"}),
    frozenset({"marker", "pen"}),
)

_TAIL = re.compile(r"\b(with|without|of|in|on|for|from|containing|and|labeled|labelled)\b.*")
_KNOWN_LABELS = 512
"""A scene asks thousands of times about its few labels."""

_PLURAL = frozenset({"scissors", "pliers", "tongs", "glasses", "chips", "headphones", "shears", "glass", "chopsticks"})


@lru_cache(_KNOWN_LABELS)
def split_label(label: str) -> tuple[str, ...]:
    """Lower-case words without numbers, so no index of a renderer survives; `object` where nothing is left."""
    words = tuple(re.findall(r"[^\W\d_]+(?:['’-][^\W\d_]+)*", label.lower()[:500]))
    return words or ("object",)


def simplify_label(label: str) -> str:
    """The label as a name for people: words only, at most six of them."""
    return " ".join(split_label(label)[:6])


@lru_cache(_KNOWN_LABELS)
def find_head_noun(label: str) -> str:
    """The noun that says what the thing is, singular: the last word before `with`, `of`, ….

    `bottle of water` is a bottle; a label that starts with such a word keeps its last.
    """
    name = " ".join(split_label(label))
    words = (_TAIL.sub("", name).split() or name.split())[-1:]
    word = words[0]
    known = word in _PLURAL or not word.endswith("s") or word.endswith("ss")
    return word if known or len(word) < 4 else word[:-1]


def classify_label(label: str) -> str:
    """One of `KINDS`, or `unknown`."""
    head = find_head_noun(label)
    for kind, words in KINDS.items():
        if head in words:
            return kind
    modifiers = set(split_label(label))
    for kind, words in KINDS.items():
        if modifiers & words:
            return kind
    return "unknown"


def is_generic(label: str) -> bool:
    """Whether the label names nothing."""
    return find_head_noun(label) in GENERIC


def is_non_tabletop(label: str) -> bool:
    """Whether the label names a living being, a part of one, or something too big for a table."""
    words = split_label(label)
    machine = {"washing", "machine"} <= set(words)
    return (find_head_noun(label) in NON_TABLETOP or machine) and not _STAND_INS & set(words)


def find_hinge_category(label: str) -> str | None:
    """The hinge's category in the paper's enumeration, or None for what has no hinge."""
    words = set(split_label(label))
    for pair, category in _HINGED_PAIRS:
        if pair <= words:
            return category
    for heads, category in _HINGED:
        if words & heads:
            return category
    return None


def look_up_size_range(label: str) -> tuple[float, float] | None:
    """Smallest and largest longest dimension of such a thing [m], where the lexicon knows it."""
    head = find_head_noun(label)
    return next(((low, high) for heads, low, high in SIZES_M if head in heads), None)


def may_share_noun(a: str, b: str) -> bool:
    """Whether two head nouns may name the same thing."""
    return a == b or any(a in group and b in group for group in _SYNONYMS)


def find_color_words(label: str) -> frozenset[str]:
    """Colours that the label itself names."""
    return frozenset(COLORS) & frozenset("grey" if word == "gray" else word for word in split_label(label))
