"""Pictures that look alike, found without comparing each with each."""

from collections.abc import Iterator, Sequence
from itertools import combinations

from tableverse_factory.sourcing.phash import HASH_BITS

MAX_BITS = 11
_WORDS = 4
_WORD_BITS = HASH_BITS // _WORDS
_WORD = (1 << _WORD_BITS) - 1


class HashIndex:
    """Hashes of which those within so many bits of another are found.

    Multi-index hashing (Norouzi, Punjani and Fleet, 2012): of two hashes that differ in at most `bits`, one of their
    four words differs in at most a quarter of that. Each hash stands in four tables by its words, and is looked for
    under every word that near.
    """

    def __init__(self, bits: int) -> None:
        self._bits = bits
        self._masks = [
            sum(1 << place for place in places)
            for flips in range(bits // _WORDS + 1)
            for places in combinations(range(_WORD_BITS), flips)
        ]
        self._tables: list[dict[int, list[tuple[int, int]]]] = [{} for _ in range(_WORDS)]

    def add(self, value: int, name: int) -> None:
        """Adds a hash under a name."""
        for table, word in zip(self._tables, _words(value), strict=True):
            table.setdefault(word, []).append((value, name))

    def nearest(self, value: int) -> tuple[int, int] | None:
        """Distance in bits and name of the nearest hash within `bits`, the smallest name of equally near ones."""
        best: tuple[int, int] | None = None
        for table, word in zip(self._tables, _words(value), strict=True):
            for mask in self._masks:
                for other, name in table.get(word ^ mask, ()):
                    distance = (other ^ value).bit_count()
                    if distance <= self._bits and (best is None or (distance, name) < best):
                        best = (distance, name)
        return best


def near_duplicates(hashes: Sequence[int], pixels: Sequence[int], bits: int) -> dict[int, tuple[int, int]]:
    """Which pictures go because a kept one looks like them.

    From the largest to the smallest, and in their order where they are equally large, a picture is kept unless one that
    is kept already lies within `bits`. What is kept depends on this order alone.

    Args:
        hashes: Of the pictures.
        pixels: How many each has.
        bits: Within which two pictures are the same.

    Returns:
        For each that goes, which is kept in its place, and the distance in bits.
    """
    index, gone = HashIndex(bits), {}
    for number in sorted(range(len(hashes)), key=lambda n: (-pixels[n], n)):
        near = index.nearest(hashes[number])
        if near is None:
            index.add(hashes[number], number)
        else:
            gone[number] = (near[1], near[0])
    return gone


def _words(value: int) -> Iterator[int]:
    return (value >> (_WORD_BITS * number) & _WORD for number in range(_WORDS))
