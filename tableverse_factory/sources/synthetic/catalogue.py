"""Catalogue of table-top objects: generator, roles and weight of each category."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from tableverse_factory.sources.synthetic import food, packages, utensils, vessels
from tableverse_factory.sources.synthetic.model import GeneratedObject

Role = Literal["container", "dish", "base", "rider", "content", "utensil", "leaner", "prop", "flat"]
"""Uses in recipes: a container is filled, a rider stands on a dish or base, contents lie in a bowl, utensils stand in
a mug, a leaner leans on a prop, flat objects are laid across an edge."""


@dataclass(frozen=True, slots=True)
class Category:
    """Generator of a category, its uses in recipes, weight of standing alone, and whether it may lie on its side."""

    make: Callable[[np.random.Generator], GeneratedObject]
    roles: tuple[Role, ...]
    weight: float = 1.0
    may_lie: bool = False


CATEGORIES: dict[str, Category] = {
    "apple": Category(food.make_apple, ("content", "rider")),
    "banana": Category(food.make_banana, ("flat",)),
    "book": Category(packages.make_book, ("base", "leaner", "flat")),
    "bottle": Category(packages.make_bottle, ("prop",), 1.5, may_lie=True),
    "bowl": Category(vessels.make_bowl, ("container", "rider")),
    "can": Category(packages.make_can, ("prop", "rider"), 1.5, may_lie=True),
    "cereal box": Category(packages.make_cereal_box, ("prop", "leaner"), may_lie=True),
    "cup": Category(vessels.make_cup, ("container", "rider")),
    "fork": Category(utensils.make_fork, ("utensil", "flat"), 0.6),
    "jar": Category(packages.make_jar, ("prop", "rider")),
    "juice carton": Category(packages.make_juice_carton, ("prop",), may_lie=True),
    "knife": Category(utensils.make_knife, ("flat",), 0.6),
    "lemon": Category(food.make_lemon, ("content",)),
    "mug": Category(vessels.make_mug, ("container", "rider"), 1.5),
    "orange": Category(food.make_orange, ("content",)),
    "pan": Category(vessels.make_pan, ("container",), 0.6),
    "pear": Category(food.make_pear, ("content",), 0.6),
    "pen": Category(utensils.make_pen, ("utensil", "flat")),
    "phone": Category(utensils.make_phone, ("leaner", "flat", "rider"), 0.8),
    "plate": Category(vessels.make_plate, ("dish",), 0.8),
    "puzzle box": Category(packages.make_game_box, ("base",), 0.8),
    "puzzle cube": Category(packages.make_puzzle_cube, ("content", "rider"), 0.6),
    "remote control": Category(utensils.make_remote, ("leaner", "flat", "rider"), 0.8),
    "sponge": Category(packages.make_sponge, ("rider",), 0.6),
    "spoon": Category(utensils.make_spoon, ("utensil", "flat"), 0.8),
    "tea box": Category(packages.make_tea_box, ("base", "rider", "prop")),
    "wooden block": Category(packages.make_wooden_block, ("content", "rider"), 0.6),
    "wooden spoon": Category(utensils.make_wooden_spoon, ("utensil", "flat"), 0.5),
}


def make_for_role(rng: np.random.Generator, role: Role) -> GeneratedObject:
    """Make an object of a random category with this role."""
    names = [name for name, category in CATEGORIES.items() if role in category.roles]
    return CATEGORIES[names[int(rng.integers(len(names)))]].make(rng)
