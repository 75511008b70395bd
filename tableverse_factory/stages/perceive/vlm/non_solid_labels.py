"""Labels of what is not solid (liquids, powders, reflections), and the containers that it fills."""

from tableverse_factory.stages.perceive.vlm.label_lexicon import parse_label, split_words

_DRINK = split_words(
    "water coffee tea milk juice soda cola lemonade beer wine whisky vodka sake espresso latte cappuccino cocoa "
    "smoothie milkshake beverage drink"
)
_FLUID = _DRINK | split_words(
    "liquid fluid broth soup stew curry oil vinegar syrup honey cream sauce ketchup mustard mayonnaise mayo dip "
    "dressing gravy salsa guacamole hummus jam jelly paste puree custard yogurt yoghurt pudding porridge oatmeal "
    "batter foam froth lather ink paint"
)
_GRAINS = split_words(
    "powder flour sugar salt rice sand soil dirt dust cereal granola oat muesli lentil quinoa couscous bulgur spice "
    "cinnamon paprika turmeric seed sprinkle crumb breadcrumb grain starch cornmeal granule gravel ash noodle "
    "spaghetti ramen pasta salad slaw confetti glitter"
)
_OPTICAL = split_words("reflection glare highlight shadow steam smoke vapor bubble air emptiness nothing stain")
_VAGUE = split_words("content stuff material substance matter mixture residue ice food")
_NOT_SOLID = _FLUID | _GRAINS | _OPTICAL | _VAGUE
_AMOUNT = split_words(
    "pile heap drop droplet layer pool puddle splash spoonful handful amount serving portion scoop dollop bit trace "
    "mound swirl bed remnant rest lot"
)
_COSMETIC = split_words("hand face body sun shaving eye foot skin baby")
_LOOSENED = split_words(
    "liquid melted ground powdered grated shredded mashed whipped granulated foamy scrambled minced"
)
# Nouns that `_LOOSENED` makes non-solid: a "powdered doughnut" stays solid
_LOOSENABLE = split_words(
    "potato cheese egg butter chocolate wax soap detergent meat beef pork chicken garlic onion ginger carrot cabbage "
    "lettuce coconut chili nut almond peanut avocado banana"
)
# Before a non-solid noun, these name its package
_PACKED = split_words(
    "canned tinned bottled boxed bagged packed packaged wrapped sealed instant cup pot can tin bottle jar box carton "
    "bag packet pouch sachet tube"
)

_VESSEL = split_words(
    "cup mug teacup tumbler beaker glass goblet stein bowl basin ramekin pot saucepan pan skillet wok casserole jar "
    "bottle flask thermos jug pitcher carafe decanter kettle teapot can tin canister bucket pail tub container vase "
    "blender shaker spoon ladle sink"
)
_FLAT = split_words("plate dish saucer platter")
_PACKAGE = split_words("box carton package packet bag sack case bin drawer")
_RACK = split_words("basket crate rack tray caddy organizer holder shelf cart stand carrier tote board cabinet")


def names_non_solid(label: str) -> bool:
    """Whether the label names a liquid, a sauce, a foam, a powder, grains, or anything without a shape of its own."""
    phrase = parse_label(label)
    before = set(phrase.before)
    if phrase.head in _AMOUNT and phrase.of:
        return phrase.of[-1] in _NOT_SOLID
    if phrase.head == "pepper":  # else it is a vegetable
        return bool({"black", "white", "ground", "cracked"} & before)
    if phrase.head == "cream" and _COSMETIC & before:  # it comes in a tube
        return False
    if phrase.head in _NOT_SOLID:
        return not before & _PACKED
    return phrase.head in _LOOSENABLE and bool(_LOOSENED & set(phrase.before[-1:]))


def fills(matter: str, container: str, *, is_listed_in_it: bool) -> bool:
    """Whether the label `matter` names a filling of the container; else it names the bottle or bowl standing in it.

    Coffee on a tray is in a cup, and rice in a basket in a bag. For a container missing from the word lists,
    `is_listed_in_it` decides: whether the model listed it as contents, or only the boxes overlap.
    """
    if not names_non_solid(matter):
        return False
    phrase, holder = parse_label(matter), parse_label(container).head
    head = phrase.of[-1] if phrase.head in _AMOUNT and phrase.of else phrase.head
    if head in _OPTICAL or holder in _VESSEL or (phrase.head in _AMOUNT and phrase.of):
        return True
    if holder in _FLAT:
        return head not in _DRINK
    if holder in _PACKAGE:
        return head not in _FLUID
    return is_listed_in_it and holder not in _RACK
