from pathlib import Path

import pytest

from tableverse_factory.sources.synthetic.synthesize import synthesize_captures

SEED, SCENES = 3, 2


@pytest.fixture(scope="session")
def synthetic_folders(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two synthetic captures on disk, made once."""
    return synthesize_captures(tmp_path_factory.mktemp("synthetic") / "captures", SCENES, SEED)
