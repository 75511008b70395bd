"""Folders that tests refer to."""

from pathlib import Path

HELPERS = Path(__file__).resolve().parent
ROOT = HELPERS.parents[1]
"""The checkout."""
SHARED = ROOT.parent / "shared"
"""The evaluation data beside it."""
