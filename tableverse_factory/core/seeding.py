"""Random generators by run, scene and stage, the same on every machine and in any order."""

import hashlib

import numpy as np


def make_rng(run_seed: int, scene_id: str, stage: str) -> np.random.Generator:
    """Make a generator that depends on its three arguments alone, through stable hashes."""
    return np.random.default_rng(np.random.SeedSequence([run_seed, _hash_word(scene_id), _hash_word(stage)]))


def _hash_word(text: str) -> int:
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:16], "little")
