"""Named colours of everyday objects, which descriptions use."""

import numpy as np
from jaxtyping import Float64

Color = Float64[np.ndarray, "3"]  # sRGB in 0–255

PALETTE: dict[str, tuple[int, int, int]] = {
    "red": (188, 48, 42),
    "orange": (224, 122, 44),
    "yellow": (232, 190, 62),
    "green": (76, 140, 74),
    "olive": (128, 130, 66),
    "teal": (42, 132, 134),
    "light blue": (128, 180, 210),
    "blue": (46, 92, 168),
    "navy": (36, 48, 92),
    "purple": (112, 74, 140),
    "pink": (222, 142, 158),
    "brown": (120, 80, 54),
    "beige": (206, 184, 150),
    "cream": (238, 228, 204),
    "white": (240, 240, 236),
    "grey": (142, 146, 150),
    "black": (44, 44, 48),
}
CERAMIC = ("white", "white", "cream", "light blue", "teal", "navy", "red", "yellow", "green", "grey", "pink", "beige")
PRINT = ("red", "orange", "yellow", "green", "teal", "light blue", "blue", "navy", "purple", "pink", "cream", "white")


def pick_color(rng: np.random.Generator, names: tuple[str, ...]) -> tuple[str, Color]:
    """Draw one of the named colours, and a shade of it."""
    name = names[int(rng.integers(len(names)))]
    return name, np.clip(np.array(PALETTE[name]) * rng.uniform(0.9, 1.08) + rng.normal(0.0, 5.0, 3), 8.0, 250.0)


def describe(adjective: str, noun: str) -> str:
    """Join an adjective and a noun: `a red bowl`, `an orange pen`."""
    return f"{'an' if adjective[0] in 'aeiou' else 'a'} {adjective} {noun}"


def find_ink_color(color: Color) -> Color:
    """Find an ink that is legible on a colour."""
    light = float(color @ np.array([0.3, 0.59, 0.11])) > 140.0
    return np.array([38.0, 38.0, 46.0]) if light else np.array([244.0, 242.0, 234.0])
