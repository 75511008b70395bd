"""Numbers of examples of laws that take long, or have more ways to break than others."""

from hypothesis import settings


def scale_examples(count: int) -> int:
    """Scale by the examples of the profile, 100 where slow tests run and 30 where not, to at least 10."""
    return max(10, count * settings.default.max_examples // 100)
