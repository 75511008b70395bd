"""Pictures of one sample per pixel: what a test reads of them is coarse, and four samples take longer."""

from collections.abc import Iterator

import pytest

from tableverse_factory.physics.render.views import FAST
from tableverse_factory.viz.gallery import pictures

_FULL = pictures.QUALITY


@pytest.fixture(scope="module", autouse=True)
def quick_pictures() -> Iterator[None]:
    """Render without antialiasing; tests/integration/browser looks at those of full quality."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(pictures, "QUALITY", FAST)
        yield


@pytest.fixture
def full_quality(monkeypatch: pytest.MonkeyPatch) -> None:
    """Render as other processes do, to which no patch comes."""
    monkeypatch.setattr(pictures, "QUALITY", _FULL)
