"""Where this machine's cache is: the environment says, or the user's own cache folder."""

import os
from pathlib import Path

CACHE_VARIABLE = "TABLEVERSE_CACHE"


def get_cache_dir() -> Path:
    """`$TABLEVERSE_CACHE`, else `tableverse-factory` in the user's cache folder. Safe to delete at any time."""
    if given := os.environ.get(CACHE_VARIABLE):
        return Path(given).expanduser().absolute()
    root = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(root) / "tableverse-factory"
