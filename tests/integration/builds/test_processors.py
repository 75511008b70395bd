"""The kernels that OpenBLAS would choose for another processor change no byte of a scene."""

import hashlib
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tableverse_factory.sources.manifest import create_manifest
from tableverse_factory.sources.synthetic.synthesize import synthesize_captures

COMMAND = [sys.executable, "-c", "from tableverse_factory.cli.main import main; main()"]


@pytest.mark.slow
@pytest.mark.skipif(" avx2 " not in Path("/proc/cpuinfo").read_text(), reason="this processor has older kernels only")
def test_other_kernels_give_the_same_scene(tmp_path: Path) -> None:
    synthesize_captures(tmp_path / "captures", 1, 3)
    create_manifest([str(tmp_path / "captures")], str(tmp_path / "images.parquet"))
    tars = {}
    for kernels in ("Haswell", "Nehalem"):
        environment = {
            **os.environ,
            "OPENBLAS_CORETYPE": kernels,
            "TABLEVERSE_CACHE": str(tmp_path / f"cache-{kernels}"),
        }
        out = tmp_path / kernels
        build = [*COMMAND, "build", str(tmp_path / "images.parquet"), str(out), "--executor", "local"]
        subprocess.run(build, env=environment, check=True, capture_output=True)
        tars[kernels] = hashlib.sha256((out / "mjcf" / "shard-00000.tar").read_bytes()).hexdigest()
    assert tars["Haswell"] == tars["Nehalem"]
