"""Splits of a dataset by picture: a scene stays in its split however the dataset grows, is cut or passed on."""

import hashlib
import re
from collections.abc import Mapping
from typing import Any

from tableverse_factory.core.errors import InputError
from tableverse_factory.core.text import sanitize_line

SPLITS = {"train": 0.8, "validation": 0.1, "test": 0.1}
"""Expected shares."""
_DIGEST = re.compile(r"[0-9a-f]{12}")


def get_split(row: Mapping[str, Any]) -> str:
    """Get the split that a row of scenes/ states, or where it is of a dataset without, the one of its `scene_id`."""
    split = str(row["split"] or find_split(row["scene_id"]))
    if split not in SPLITS:
        scene, stated = sanitize_line(str(row["scene_id"]), 80), sanitize_line(repr(split), 80)
        raise InputError(f"scene {scene}: split {stated} is none of {', '.join(SPLITS)}", "bad_table")
    return split


def find_split(family: str) -> str:
    """Find the split of a family: a scene, by whose id it goes, and all of its cousins.

    The hash of the input, which is part of that id, decides: one picture has one split, whatever its name.
    """
    key = next(reversed(_DIGEST.findall(family)), family)
    drawn = int(hashlib.sha256(f"split {key}".encode()).hexdigest()[:8], 16) / 2**32
    for name, share in SPLITS.items():
        if drawn < share:
            return name
        drawn -= share
    return name
