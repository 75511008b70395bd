"""Material priors from labels: density, friction, and the share of the volume that is matter.

A prior, not a measurement: the judge may correct it within `compute_mass_bounds_kg`.
Densities are handbook values; fill and wall are typical of household goods.
"""

import re
from dataclasses import dataclass

import numpy as np

from schemas.geometry import Vector3
from tableverse_factory.core.text import to_singular

MIN_MASS_KG = 0.002
MAX_MASS_KG = 30.0
_SURFACE_SHARE = 0.8  # of a rounded object over its box: pi/4 for an upright cylinder, 0.52 to 1 for ball and box


@dataclass(frozen=True, slots=True)
class Material:
    """A substance and how it fills an object.

    Attributes:
        density_kg_m3: Of the matter itself [kg/m³].
        fill: Share of the mesh's volume that is matter, 0 to 1.
        wall_m: Wall [m] of what is hollow, which bounds the mass where the mesh is solid; None for solid objects.
        rolling: Tangent of the slope on which a round object of it starts to roll.
    """

    name: str
    density_kg_m3: float
    friction: float
    fill: float = 1.0
    wall_m: float | None = None
    rolling: float = 0.2


DEFAULT_MATERIAL = Material("plastic", 1050.0, 0.8, fill=0.35)

_CERAMIC = Material("ceramic", 2300.0, 0.7, wall_m=0.004)
_GLASS = Material("glass", 2500.0, 0.7, wall_m=0.003)
_SHEET_METAL = Material("metal", 7800.0, 0.7, wall_m=0.0012)
_METAL = Material("metal", 7800.0, 0.7)
_TOOL = Material("metal", 7800.0, 0.7, fill=0.45)
_CUTLERY = Material("metal", 7800.0, 0.7, wall_m=0.0004)  # 2 mm over a fifth of the box: meshes are far too thick
_FILLED = Material("filled container", 1000.0, 0.8, fill=0.9)
_CARTON = Material("carton", 700.0, 0.8, fill=0.5)
_PAPER = Material("paper", 750.0, 0.8)
_WOOD = Material("wood", 650.0, 0.8)
_FRUIT = Material("food", 950.0, 0.8, rolling=0.25)
_BAKED = Material("food", 400.0, 0.9, rolling=0.3)
_FABRIC = Material("fabric", 200.0, 1.0, rolling=0.3)
_SOFT_PLASTIC = Material("plastic", 1050.0, 0.8, wall_m=0.002)
_DEVICE = Material("device", 1600.0, 0.8, fill=0.7)
_RUBBER = Material("rubber", 1100.0, 1.0, fill=0.5)
_HOLLOW_TOY = Material("plastic", 1050.0, 0.8, fill=0.2)

# The first row that knows a word of the label decides: matter before kind ("wooden bowl" is wood), kind before PLAIN.
LEXICON: tuple[tuple[frozenset[str], Material], ...] = tuple(
    (frozenset(words.split()), material)
    for words, material in (
        ("wooden wood bamboo cutting", _WOOD),
        ("toy plush doll figurine lego block puzzle", _HOLLOW_TOY),
        ("paper book notebook magazine envelope card napkin tissue newspaper", _PAPER),
        ("cardboard carton cereal cracker box package packet bag pouch", _CARTON),
        ("towel cloth fabric sponge glove hat sock pillow", _FABRIC),
        ("can tin bottle jar tube shampoo mustard ketchup sauce milk juice soda drink detergent", _FILLED),
        ("plastic", _SOFT_PLASTIC),
        ("glass wineglass goblet vase", _GLASS),
        ("pan frypan pot wok kettle tray saucepan skillet steel aluminium aluminum", _SHEET_METAL),
        ("fork knife spoon teaspoon spatula whisk tongs ladle", _CUTLERY),
        ("scissors key coin screw nail bolt nut", _METAL),
        ("hammer wrench screwdriver pliers clamp stapler opener drill tool padlock lock", _TOOL),
        ("mug cup bowl plate dish saucer ramekin teapot porcelain ceramic pitcher planter", _CERAMIC),
        (
            "apple banana orange lemon lime pear peach plum strawberry tomato potato onion carrot pepper fruit "
            "vegetable avocado mango grape cucumber egg cheese meat melon pineapple kiwi",
            _FRUIT,
        ),
        ("bread bun croissant cake cookie biscuit chip donut muffin sandwich pizza", _BAKED),
        ("phone remote camera mouse keyboard laptop tablet clock watch speaker charger flashlight calculator", _DEVICE),
        ("ball tire eraser rubber", _RUBBER),
        ("pencil stick honey dipper chopstick brush", _WOOD),
    )
)


def guess_material(label: str) -> Material:
    """Guess the material from the words of a label (untrusted text); `DEFAULT_MATERIAL` where none is known."""
    words = set(re.findall(r"[a-z]+", label.lower()[:500]))
    words |= {to_singular(word) for word in words} | ({"glass"} if "glasses" in words else set())
    return next((material for keywords, material in LEXICON if words & keywords), DEFAULT_MATERIAL)


def estimate_rolling_friction_m(label: str, size: Vector3) -> float:
    """Estimate MuJoCo's rolling friction for a label and box size [m]: a length, the slope times the radius.

    Real marbles roll down far gentler slopes, but a simulated one rocks forever on the facets of its hull.
    """
    return guess_material(label).rolling * float(np.min(size)) / 2


def estimate_mass_kg(label: str, volume_m3: float, size: Vector3) -> float:
    """Estimate the mass for a label, mesh volume and box size [m], within sensible bounds [kg]."""
    material = guess_material(label)
    matter = max(volume_m3, 0.0) * material.fill
    if material.wall_m is not None:
        matter = min(matter, material.wall_m * _estimate_surface_m2(size))
    return min(max(matter * material.density_kg_m3, MIN_MASS_KG), MAX_MASS_KG)


def compute_mass_bounds_kg(volume_m3: float, size: Vector3) -> tuple[float, float]:
    """Compute the lightest and heaviest possible mass [kg]: a paper skin, and solid steel."""
    lightest = 0.0002 * _estimate_surface_m2(size) * 300.0
    heaviest = max(volume_m3, 0.0) * 8000.0
    low = min(max(lightest, MIN_MASS_KG / 2), MAX_MASS_KG)
    return low, min(max(heaviest, 2 * low), 2 * MAX_MASS_KG)


def _estimate_surface_m2(size: Vector3) -> float:
    a, b, c = (float(side) for side in size)
    return 2 * _SURFACE_SHARE * (a * b + b * c + c * a)
