"""The order in which an epoch's scenes come, as numbers alone: the same for every worker, nothing is read for it."""

import numpy as np
from jaxtyping import Int64

from tableverse_factory.core.seeding import rng_for

Indices = Int64[np.ndarray, " n"]


def order(shards: Indices, seed: int, epoch: int, buffer: int) -> Indices:
    """Indices of all scenes in the order of an epoch.

    Shards come in a shuffled order, and a buffer mixes the scenes of those that follow one another: each next scene is
    drawn from the `buffer` that are waiting. What waits are numbers, not scenes, so that a buffer costs no memory; it
    is bounded only so that scenes that are read soon after one another lie in few shards.

    Args:
        shards: Number of each scene's shard, in the order of the table. Shape (n,).
        seed: Of the shuffle.
        epoch: Another order for each.
        buffer: How many scenes wait; 0 keeps the order of the table, in every epoch.

    Returns:
        A permutation of 0 to n - 1.
    """
    if buffer == 0:
        return np.arange(len(shards), dtype=np.int64)
    rng = rng_for(seed, "stream", f"epoch {epoch}")
    rank = np.empty(int(shards.max(initial=-1)) + 1, dtype=np.int64)
    present = np.unique(shards)
    rank[present] = rng.permutation(len(present))
    by_shard = np.argsort(rank[shards], kind="stable")
    waiting, rest = by_shard[:buffer].copy(), by_shard[buffer:]
    drawn = np.empty(len(by_shard), dtype=np.int64)
    for position, (slot, following) in enumerate(zip(rng.integers(buffer, size=len(rest)), rest, strict=True)):
        drawn[position], waiting[slot] = waiting[slot], following
    drawn[len(rest) :] = rng.permutation(waiting)
    return drawn


def part_of(ordered: Indices, index: int, of: int, even_for: int = 1) -> Indices:
    """Every `of`-th scene, from the one at `index` on: the parts share nothing, and together they are all.

    Args:
        ordered: Of an epoch.
        index: Which part, from 0.
        of: How many parts.
        even_for: Leave out the last few scenes of the order, fewer than this, so that as many parts are equally long.
    """
    part: Indices = ordered[: len(ordered) - len(ordered) % even_for][index::of]
    return part
