"""Families of scenes, which stay together in every split: a scene and all cousins that are derived from it."""

import hashlib

FOLDS = 5
"""Parts into which families are divided; splits are made of whole folds. Cousins borrow things within a fold only."""


def find_fold(family: str) -> int:
    """Find the fold of a family, which depends on its name alone: 0 to `FOLDS` - 1."""
    return int.from_bytes(hashlib.sha256(family.encode()).digest()[:8], "little") % FOLDS
