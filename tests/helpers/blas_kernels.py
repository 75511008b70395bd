"""Kernels of OpenBLAS as the children of builds have them, chosen before numpy loads it.

Results that a test computes in its own process then have the last digits of those of a build, on any processor.
"""

import os
from pathlib import Path

if " avx2 " in Path("/proc/cpuinfo").read_text():
    os.environ.setdefault("OPENBLAS_CORETYPE", "Haswell")
