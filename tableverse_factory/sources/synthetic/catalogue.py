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
    roles: frozenset[Role]
    weight: float = 1.0
    may_lie: bool = False


def _roles(*roles: Role) -> frozenset[Role]:
    return frozenset(roles)


CATEGORIES: dict[str, Category] = {
    "apple": Category(food.make_apple, _roles("content", "rider")),
    "banana": Category(food.make_banana, _roles("flat")),
    "book": Category(packages.make_book, _roles("base", "leaner", "flat")),
    "bottle": Category(packages.make_bottle, _roles("prop"), 1.5, may_lie=True),
    "bowl": Category(vessels.make_bowl, _roles("container", "rider")),
    "can": Category(packages.make_can, _roles("prop", "rider"), 1.5, may_lie=True),
    "cereal box": Category(packages.make_cereal_box, _roles("prop", "leaner"), may_lie=True),
    "cup": Category(vessels.make_cup, _roles("container", "rider")),
    "fork": Category(utensils.make_fork, _roles("utensil", "flat"), 0.6),
    "jar": Category(packages.make_jar, _roles("prop", "rider")),
    "juice carton": Category(packages.make_juice_carton, _roles("prop"), may_lie=True),
    "knife": Category(utensils.make_knife, _roles("flat"), 0.6),
    "lemon": Category(food.make_lemon, _roles("content")),
    "mug": Category(vessels.make_mug, _roles("container", "rider"), 1.5),
    "orange": Category(food.make_orange, _roles("content")),
    "pan": Category(vessels.make_pan, _roles("container"), 0.6),
    "pear": Category(food.make_pear, _roles("content"), 0.6),
    "pen": Category(utensils.make_pen, _roles("utensil", "flat")),
    "phone": Category(utensils.make_phone, _roles("leaner", "flat", "rider"), 0.8),
    "plate": Category(vessels.make_plate, _roles("dish"), 0.8),
    "puzzle box": Category(packages.make_game_box, _roles("base"), 0.8),
    "puzzle cube": Category(packages.make_puzzle_cube, _roles("content", "rider"), 0.6),
    "remote control": Category(utensils.make_remote, _roles("leaner", "flat", "rider"), 0.8),
    "sponge": Category(packages.make_sponge, _roles("rider"), 0.6),
    "spoon": Category(utensils.make_spoon, _roles("utensil", "flat"), 0.8),
    "tea box": Category(packages.make_tea_box, _roles("base", "rider", "prop")),
    "wooden block": Category(packages.make_wooden_block, _roles("content", "rider"), 0.6),
    "wooden spoon": Category(utensils.make_wooden_spoon, _roles("utensil", "flat"), 0.5),
}


def make_for_role(rng: np.random.Generator, role: Role) -> GeneratedObject:
    """Make an object of a random category with this role."""
    names = [name for name, category in CATEGORIES.items() if role in category.roles]
    return CATEGORIES[names[int(rng.integers(len(names)))]].make(rng)
