"""Two models that share one GPU by fractions of it, on a real Ray; an actor is killed, and nothing is lost."""

import os
from dataclasses import replace

import psutil
import pytest

from schemas.pools import Pools, PoolSpec
from tests.helpers.builds import Silent, digests, request, scenes, write_manifest
from tests.helpers.paths import ROOT
from workers.run import run_build

torch = pytest.importorskip("torch", reason="the extra `models` is not installed")
pytestmark = [pytest.mark.slow, pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU here")]

HALVES = Pools(perception=PoolSpec(gpus=0.5, min=1), geometry=PoolSpec(gpus=0.5, min=1), physics=PoolSpec(cpus=0.5))


class Killing(Silent):
    """Kills one actor as soon as a third of the scenes is done."""

    def __init__(self, after: int):
        super().__init__()
        self.after, self.killed, self.losses = after, 0, 0

    def show(self, tally):
        self.losses = tally.losses
        if not self.killed and tally.accounted >= self.after:
            actors = [
                p for p in psutil.Process().children(recursive=True) if "ray::StageActor" in " ".join(p.cmdline())
            ]
            self.killed = max(actors, key=lambda process: process.cpu_times().user).pid
            os.kill(self.killed, 9)


def test_two_models_share_a_gpu_and_one_actor_dies(tmp_path, monkeypatch):
    paths = [str(ROOT), os.environ.get("PYTHONPATH", "")]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(paths))
    monkeypatch.setenv("GPU_LINE_MARKS", str(tmp_path))
    manifest = write_manifest(tmp_path / "m.parquet", ["fine"] * 120)
    asked = replace(
        request(manifest, tmp_path / "whole", deadline_s=120.0, memory_mb=16_000),
        pipeline="tests.helpers.gpu_pipeline:PIPELINES",
        executor="ray",
        pools=HALVES,
    )
    run_build(asked, Silent())
    seen = {path.name.partition(".")[0]: path.read_text() for path in tmp_path.glob("p*.[0-9]*")}
    assert seen == {"perceive": "0", "place": "0"}, "each model has its process, and both see the one GPU"
    assert {row["status"] for row in scenes(tmp_path / "whole")} == {"done"}

    display = Killing(after=40)
    run_build(replace(asked, out=tmp_path / "out"), display)
    assert display.killed
    assert display.losses >= 1
    assert digests(tmp_path / "out") == digests(tmp_path / "whole")
