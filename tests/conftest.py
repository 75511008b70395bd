"""What every test may lean on."""

from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def shared_dir() -> Path:
    """The evaluation data beside the checkout: real captures, scanned meshes, cluttered layouts."""
    path = Path(__file__).resolve().parents[2] / "shared"
    if not path.is_dir():
        pytest.skip("the evaluation data is not beside this checkout")
    return path
