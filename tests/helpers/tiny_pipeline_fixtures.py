"""Fixtures of the builds of the tiny pipeline."""

from collections import Counter

import pytest


@pytest.fixture
def marks(tmp_path, monkeypatch):
    """How often each stage ran on each scene since it was last asked."""
    folder = tmp_path / "marks"
    folder.mkdir()
    monkeypatch.setenv("TINY_LINE_MARKS", str(folder))

    def count() -> Counter[str]:
        counts: Counter[str] = Counter()
        for path in folder.iterdir():
            counts[path.name] += path.stat().st_size
            path.unlink()
        return counts

    return count
