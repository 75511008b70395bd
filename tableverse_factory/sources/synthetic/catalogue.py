"""The table of what stands on tables: each category, who makes it, and what it may be used for."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from tableverse_factory.sources.synthetic import food, packages, utensils, vessels
from tableverse_factory.sources.synthetic.model import Model

Role = Literal["container", "dish", "base", "rider", "content", "utensil", "leaner", "prop", "flat"]
"""What recipes ask for: a container is filled, a dish or base is stood upon by a rider, contents lie in a bowl,
utensils stand in a mug, a leaner leans on a prop, flat things are laid across an edge."""


@dataclass(frozen=True, slots=True)
class Category:
    """One kind of thing.

    Attributes:
        make: Draws a specimen.
        roles: What recipes may use it for.
        weight: How often it stands alone, relative to the others.
        may_lie: Whether it is also found on its side.
    """

    make: Callable[[np.random.Generator], Model]
    roles: frozenset[Role]
    weight: float = 1.0
    may_lie: bool = False


def _roles(*roles: Role) -> frozenset[Role]:
    return frozenset(roles)


CATEGORIES: dict[str, Category] = {
    "apple": Category(food.apple, _roles("content", "rider")),
    "banana": Category(food.banana, _roles("flat")),
    "book": Category(packages.book, _roles("base", "leaner", "flat")),
    "bottle": Category(packages.bottle, _roles("prop"), 1.5, may_lie=True),
    "bowl": Category(vessels.bowl, _roles("container", "rider")),
    "can": Category(packages.can, _roles("prop", "rider"), 1.5, may_lie=True),
    "cereal box": Category(packages.cereal_box, _roles("prop", "leaner"), may_lie=True),
    "cup": Category(vessels.cup, _roles("container", "rider")),
    "fork": Category(utensils.fork, _roles("utensil", "flat"), 0.6),
    "jar": Category(packages.jar, _roles("prop", "rider")),
    "juice carton": Category(packages.juice_carton, _roles("prop"), may_lie=True),
    "knife": Category(utensils.knife, _roles("flat"), 0.6),
    "lemon": Category(food.lemon, _roles("content")),
    "mug": Category(vessels.mug, _roles("container", "rider"), 1.5),
    "orange": Category(food.orange, _roles("content")),
    "pan": Category(vessels.pan, _roles("container"), 0.6),
    "pear": Category(food.pear, _roles("content"), 0.6),
    "pen": Category(utensils.pen, _roles("utensil", "flat")),
    "phone": Category(utensils.phone, _roles("leaner", "flat", "rider"), 0.8),
    "plate": Category(vessels.plate, _roles("dish"), 0.8),
    "puzzle box": Category(packages.game_box, _roles("base"), 0.8),
    "puzzle cube": Category(packages.puzzle_cube, _roles("content", "rider"), 0.6),
    "remote control": Category(utensils.remote, _roles("leaner", "flat", "rider"), 0.8),
    "sponge": Category(packages.sponge, _roles("rider"), 0.6),
    "spoon": Category(utensils.spoon, _roles("utensil", "flat"), 0.8),
    "tea box": Category(packages.tea_box, _roles("base", "rider", "prop")),
    "wooden block": Category(packages.wooden_block, _roles("content", "rider"), 0.6),
    "wooden spoon": Category(utensils.wooden_spoon, _roles("utensil", "flat"), 0.5),
}


def make_one(rng: np.random.Generator, role: Role) -> Model:
    """A specimen of a random category that fits the role."""
    names = [name for name, category in CATEGORIES.items() if role in category.roles]
    return CATEGORIES[names[int(rng.integers(len(names)))]].make(rng)
