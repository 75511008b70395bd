"""Vocabulary of the rules: kinds, hinges, sizes, and what goes where in daily life. Labels are untrusted text.

The head noun decides: a `dog bowl` is a bowl, a `mug with a cat` is a mug, a `toy car` is a toy.
"""

import re
from functools import lru_cache

GENERIC = frozenset({"object", "thing", "item", "unknown"})
COLORS = ("black", "white", "grey", "brown", "red", "orange", "yellow", "green", "blue", "purple", "pink")


def _split_values(**words: str) -> dict[str, frozenset[str]]:
    return {name: frozenset(value.split()) for name, value in words.items()}


# Head nouns of each kind of table-top object.
KINDS = _split_values(
    drinkware="mug cup glass tumbler wineglass goblet teacup",
    dish="plate saucer dish platter board coaster placemat",
    bowl="bowl ramekin basin colander strainer",
    cookware="pan frypan pot wok saucepan skillet casserole",
    storage="basket tray bin bucket pail crate container trashcan holder organizer drawer vase planter case pencilcase",
    cutlery="fork knife spoon chopstick chopsticks ladle spatula whisk tongs peeler dipper opener grater",
    food="apple banana orange lemon lime pear peach plum strawberry tomato potato onion carrot pepper fruit "
    "vegetable avocado mango grape cucumber egg cheese meat melon pineapple kiwi bread bun croissant cake cookie "
    "biscuit chip chips donut muffin sandwich pizza broccoli mushroom corn garlic cherry grapes",
    packaged="can tin bottle carton box package packet bag pouch jar ketchup mustard sauce milk juice soda "
    "cereal pitcher jug teapot kettle",
    toiletry="shampoo soap lotion toothpaste toothbrush detergent sanitizer cream razor deodorant sponge",
    tool="hammer wrench screwdriver pliers clamp drill padlock lock flashlight tape nail screw bolt nut",
    office="stapler pen pencil marker eraser notebook book scissors magazine envelope ruler glue card",
    device="phone remote camera mouse keyboard laptop tablet clock watch speaker charger calculator headphones",
    toy="toy ball puzzle block blocks lego doll figurine plush cube dice car",
)
# Kinds that people put into a container of a kind.
CONTENTS = _split_values(
    drinkware="cutlery food office",
    bowl="food packaged cutlery toy drinkware bowl",
    cookware="food cutlery",
    storage="drinkware dish bowl cutlery food packaged toiletry tool office device toy unknown",
    packaged="food cutlery office toy tool unknown",
    unknown="food packaged cutlery toiletry tool office device toy unknown",
)
# Kinds that people put on top of an object of a kind.
CARRIES = _split_values(
    dish="food drinkware bowl cutlery packaged dish",
    storage="drinkware dish bowl cutlery food packaged toiletry tool office device toy unknown",
    packaged="packaged toy office",
    office="drinkware packaged office toy device unknown",
    toy="toy",
    unknown="drinkware dish bowl packaged toiletry tool office device toy unknown",
)
# Names that belong on no table, and words that turn such a name into that of a small object.
_WORDS = _split_values(
    living_or_large="person man woman child boy girl baby people human face hand arm leg foot finger head body "
    "dog cat bird horse cow rabbit hamster fish turtle snake "
    "refrigerator fridge freezer oven stove dishwasher microwave washer dryer sofa couch bed chair armchair "
    "bookshelf wardrobe cabinet bathtub toilet sink door window bicycle motorcycle truck bus tree car",
    miniature="toy figurine statue model miniature plush doll stuffed plastic lego picture photo sculpture "
    "ornament hot",
)
# Head nouns, and the smallest and largest longest dimension of such an object [m].
SIZES_M = (
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
# Hinge categories and the names that have one, the first match deciding; all words of a name must occur.
_HINGED = (
    ("TrashCan", "trash can, garbage can"),
    ("Box", "lunch box, tool box, jewelry box, pizza box"),
    ("Laptop", "laptop"),
    ("Scissors", "scissors, shears"),
    ("Pliers", "pliers, tongs, clamp, nippers"),
    ("TrashCan", "trashcan, wastebasket, dustbin"),
    ("Bucket", "bucket, pail"),
    ("Bottle", "shampoo, mustard, ketchup, lotion, detergent, sanitizer"),
    ("Box", "lunchbox, toolbox, briefcase, suitcase"),
)
_SYNONYMS = (
    *({"mug", "cup", "teacup"}, {"can", "tin"}, {"box", "carton", "package", "packet"}, {"bowl", "ramekin", "basin"}),
    *({"plate", "dish", "saucer", "platter"}, {"pan", "frypan", "skillet"}, {"marker", "pen"}),
)
_TAIL = re.compile(r"\b(with|without|of|in|on|for|from|containing|and|labeled|labelled)\b.*")
_KNOWN_LABELS = 512  # cache size; a scene has few labels, looked up thousands of times
_PLURAL = frozenset({"scissors", "pliers", "tongs", "glasses", "chips", "headphones", "shears", "glass", "chopsticks"})


@lru_cache(_KNOWN_LABELS)
def split_label(label: str) -> tuple[str, ...]:
    """Split a label into lower-case words without numbers and indices; `object` where nothing is left."""
    words = tuple(re.findall(r"[^\W\d_]+(?:['’-][^\W\d_]+)*", label.lower()[:500]))
    return words or ("object",)


@lru_cache(_KNOWN_LABELS)
def find_head_noun(label: str) -> str:
    """Find the noun that names the object, in the singular: the last word before `with`, `of` and the like.

    `bottle of water` is a bottle; a label that starts with such a word keeps its last.
    """
    name = " ".join(split_label(label))
    word = (_TAIL.sub("", name).split() or name.split())[-1]
    known = word in _PLURAL or not word.endswith("s") or word.endswith("ss")
    return word if known or len(word) < 4 else word[:-1]


def classify_label(label: str) -> str:
    """Classify a label as one of `KINDS`, by its head noun, else by any word; else `unknown`."""
    for nouns in ({find_head_noun(label)}, set(split_label(label))):
        for kind, words in KINDS.items():
            if nouns & words:
                return kind
    return "unknown"


def find_kind(label: str) -> str:
    """Find the kind of a thing: one of `KINDS`, or the head noun of a label that is in none."""
    kind = classify_label(label)
    return find_head_noun(label) if kind == "unknown" else kind


def is_generic(label: str) -> bool:
    """Whether the label names nothing in particular."""
    return find_head_noun(label) in GENERIC


def is_non_tabletop(label: str) -> bool:
    """Whether the label names a living being, a part of one, or an object too large for a table."""
    words = split_label(label)
    machine = {"washing", "machine"} <= set(words)
    return (find_head_noun(label) in _WORDS["living_or_large"] or machine) and not _WORDS["miniature"] & set(words)


def find_hinge_category(label: str) -> str | None:
    """Find the hinge's category in the paper's enumeration; None for what has no hinge."""
    words = set(split_label(label))
    hinged = (category for category, names in _HINGED for name in names.split(", ") if set(name.split()) <= words)
    return next(hinged, None)


def look_up_size_range(label: str) -> tuple[float, float] | None:
    """Look up the smallest and largest longest dimension of such an object [m]; None where the lexicon has none."""
    head = find_head_noun(label)
    return next(((low, high) for heads, low, high in SIZES_M if head in heads.split()), None)


def may_share_noun(a: str, b: str) -> bool:
    """Whether two head nouns may name the same thing."""
    return a == b or any(a in group and b in group for group in _SYNONYMS)


def unify_noun(noun: str) -> str:
    """Replace a head noun by the first of those that may name the same thing."""
    return min({noun}.union(*(group for group in _SYNONYMS if noun in group)))


def find_color_words(label: str) -> frozenset[str]:
    """Find the colours that the label itself names."""
    return frozenset(COLORS) & frozenset("grey" if word == "gray" else word for word in split_label(label))
