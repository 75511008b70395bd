"""How many examples a law is tried on that takes long, or has more ways to break than others."""

from hypothesis import settings


def examples(count: int) -> int:
    """So many where slow tests run, three tenths of them in the fast run."""
    return count * settings.default.max_examples // 100
