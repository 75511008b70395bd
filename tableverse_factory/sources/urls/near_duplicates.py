"""Near duplicates of pictures, found by multi-index hashing."""

from collections.abc import Sequence

import numpy as np

from tableverse_factory.sources.urls.phash import HASH_BITS

MAX_BITS = 7  # Beyond, different scenes look alike; up to it, one of four words differs in at most one bit
_WORDS = 4
_WORD_BITS = HASH_BITS // _WORDS
_WORD_SHIFTS = tuple(range(0, HASH_BITS, _WORD_BITS))
_WORD_MASK = (1 << _WORD_BITS) - 1
_SCAN_SHARE = 32  # A scan of all hashes is cheaper when more than one in this many shares a word


class HashIndex:
    """Index of hashes that finds those within some bits of another.

    Multi-index hashing (Norouzi, Punjani and Fleet, 2012): of two hashes that differ in at most `bits`, one of their
    four words differs in at most a quarter of that. Each hash stands in four tables by its words, and is looked for
    under every word that near. Frames of one film share most words: then a plain scan bounds the work.
    """

    def __init__(self, bits: int, capacity: int) -> None:
        self._bits = bits
        self._masks = (0, *(1 << place for place in range(_WORD_BITS))) if bits >= _WORDS else (0,)
        self._tables: tuple[dict[int, list[int]], ...] = ({}, {}, {}, {})
        self._hashes: list[int] = []
        self._all = np.zeros(capacity, dtype=np.uint64)

    def add(self, value: int) -> None:
        """Add a hash; its place is the number of those added before."""
        place = len(self._hashes)
        for table, shift in zip(self._tables, _WORD_SHIFTS, strict=True):
            table.setdefault(value >> shift & _WORD_MASK, []).append(place)
        self._all[place] = value
        self._hashes.append(value)

    def nearest(self, value: int) -> tuple[int, int] | None:
        """Find distance [bits] and place of the nearest hash within `bits`, the first of equally near ones."""
        found: list[int] = []
        for table, shift in zip(self._tables, _WORD_SHIFTS, strict=True):
            word = value >> shift & _WORD_MASK
            for mask in self._masks:
                if (places := table.get(word ^ mask)) is not None:
                    found += places
        if len(found) > 1000 and len(found) * _SCAN_SHARE > len(self._hashes):
            distances = np.bitwise_count(self._all[: len(self._hashes)] ^ np.uint64(value))
            place = int(distances.argmin())
            best = (int(distances[place]), place)
        else:
            best = min((((self._hashes[place] ^ value).bit_count(), place) for place in found), default=(HASH_BITS, 0))
        return best if best[0] <= self._bits else None


def find_near_duplicates(hashes: Sequence[int], worth: Sequence[int], bits: int) -> dict[int, tuple[int, int]]:
    """Find pictures to drop, each with the picture that is kept in its place, and the distance [bits].

    From the one worth most to the one worth least, and in their order where they are worth the same, a picture is kept
    unless one that is kept already lies within `bits`. What is kept depends on this order alone.
    """
    index = HashIndex(bits, len(hashes))
    kept: list[int] = []
    gone: dict[int, tuple[int, int]] = {}
    for number in sorted(range(len(hashes)), key=lambda n: (-worth[n], n)):
        near = index.nearest(hashes[number])
        if near is None:
            index.add(hashes[number])
            kept.append(number)
        else:
            gone[number] = (kept[near[1]], near[0])
    return gone
