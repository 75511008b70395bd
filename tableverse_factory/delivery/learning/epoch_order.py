"""Order of an epoch's scenes, computed from indices alone and equal in every worker."""

import numpy as np
from jaxtyping import Int64

from tableverse_factory.core.seeding import make_rng

Indices = Int64[np.ndarray, " n"]


def shuffle_epoch(shards: Indices, seed: int, epoch: int, buffer: int) -> Indices:
    """Shuffle all scenes of an epoch: a permutation of 0 to n - 1.

    Shards are shuffled, and a buffer mixes the scenes of consecutive shards: each next scene is drawn from `buffer`
    waiting ones. Only indices wait, so a buffer costs no memory; it is bounded so that scenes read in succession lie in
    few shards. With `buffer` 0 the order is that of the table, in every epoch. `shards` holds each scene's shard
    number.
    """
    if buffer == 0:
        return np.arange(len(shards), dtype=np.int64)
    rng = make_rng(seed, "stream", f"epoch {epoch}")
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


def take_part(ordered: Indices, index: int, of: int, even_for: int = 1) -> Indices:
    """Take every `of`-th scene from `index` on; the parts are disjoint and complete.

    `even_for` drops the last few scenes of the order, fewer than this, so that as many parts are equally long.
    """
    part: Indices = ordered[: len(ordered) - len(ordered) % even_for][index::of]
    return part
