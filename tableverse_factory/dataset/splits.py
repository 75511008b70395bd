"""Splits of a dataset by picture: a scene stays in its split however the dataset grows, is cut or passed on."""

import hashlib
from collections.abc import Mapping
from typing import Any

SPLITS = {"train": 0.8, "validation": 0.1, "test": 0.1}
"""Expected shares."""


def find_split(row: Mapping[str, Any]) -> str:
    """Find the split of a row of scenes/ from the hash of its input, so that scenes of one picture stay together."""
    key = row["content_sha256"] or row["scene_id"]
    drawn = int(hashlib.sha256(f"split {key}".encode()).hexdigest()[:8], 16) / 2**32
    for name, share in SPLITS.items():
        if drawn < share:
            return name
        drawn -= share
    return name
