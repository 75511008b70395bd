"""Kernels and threads of OpenBLAS as the children of builds have them, chosen before numpy loads it.

Results that a test computes in its own process then have the last digits of those of a build, on any processor.
"""

import os
import sys
from pathlib import Path

import pytest

if "OPENBLAS_CORETYPE" not in os.environ and " avx2 " in Path("/proc/cpuinfo").read_text():
    if "numpy" in sys.modules:
        raise pytest.UsageError(
            "a plugin of pytest imports numpy too early: name it in addopts (pyproject.toml) as `-p no:`"
        )
    os.environ["OPENBLAS_CORETYPE"] = "Haswell"
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
