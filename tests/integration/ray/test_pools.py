"""Pools on a real Ray: actors with needs of their own, replaced after so many scenes; the same bytes all the same."""

import os
from dataclasses import replace

import pytest

from schemas.config import Config, CurateConfig
from schemas.pools import Pools, PoolSpec
from tableverse_factory.core.errors import BuildError, ConfigError
from tableverse_factory.core.pools_file import load_pools
from tests.helpers.builds import Silent, build, digests, request, write_manifest
from tests.helpers.paths import ROOT
from workers.run import run_build

NAMES = ["fine", "empty", "fine", "fine", "fell", "fine", "sad", *["slow_0.1"] * 6]
OWN = Pools(
    perception=PoolSpec(cpus=0.25, min=1),
    geometry=PoolSpec(cpus=0.5, recycle_after=2),
    physics=PoolSpec(cpus=0.5),
    curation=PoolSpec(cpus=0.5),
)


class Watching(Silent):
    """Keeps the most actors that each pool had."""

    def __init__(self):
        super().__init__()
        self.most = {}

    def show(self, tally):
        for pool, actors in tally.actors.items():
            self.most[pool] = max(self.most.get(pool, 0), actors.alive)


@pytest.mark.slow
def test_pools_of_their_own_give_the_same_bytes(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]))
    manifest = write_manifest(tmp_path / "m.parquet", NAMES)
    build(manifest, tmp_path / "local", deadline_s=60.0)
    seen = Watching()
    asked = request(manifest, tmp_path / "out", deadline_s=60.0)
    run_build(replace(asked, executor="ray", workers=2, pools=OWN), seen)
    assert digests(tmp_path / "out") == digests(tmp_path / "local")
    assert set(seen.most) == {"perception", "geometry", "physics+curation"}, "pools that ask for the same share actors"
    assert all(count >= 1 for count in seen.most.values())


@pytest.mark.slow  # test_pool_capacity.py refuses them without Ray
def test_pools_that_can_never_be_are_refused_before_anything_waits(tmp_path):
    manifest = write_manifest(tmp_path / "m.parquet", NAMES)
    asked = request(manifest, tmp_path / "out", deadline_s=60.0)
    greedy = Pools(perception=PoolSpec(gpus=3))
    with pytest.raises(BuildError, match=r"pool perception wants 3 GPUs .*--pools"):
        run_build(replace(asked, executor="ray", workers=2, pools=greedy), Silent())
    assert list((tmp_path / "out").iterdir()) == []


def test_a_file_of_pools(tmp_path):
    path = tmp_path / "pools.yaml"
    path.write_text("perception: {cpus: 2, gpus: 0.5, max: 8}\ngeometry:\n  resources: {fast_disk: 1}\n")
    pools = load_pools(path, Config())
    assert pools.perception == PoolSpec(cpus=2, gpus=0.5, max=8)
    assert pools.geometry.needs() == {"CPU": 1.0, "fast_disk": 1.0}
    assert pools.curation == PoolSpec()
    asking = Config(curate=CurateConfig(judge="openai", base_url="http://localhost:1/v1", model="m"))
    assert load_pools(path, asking).curation.cpus < 1, "an actor that waits for an answer needs no CPU of its own"
    for text, says in {
        "percepton: {}": r"percepton: .*; did you mean perception\? \(pools are",
        "physics: {cpu: 1}": r"physics\.cpu: .*; did you mean cpus\? ",
        "physics: {cpus: -1}": "physics.cpus",
        "physics: {gpus: 1.5}": "a whole number",
        "physics: {cpus: 0.00001}": "steps of 0.0001",
        "physics: {resources: {GPU: 1}}": "give cpus, gpus or memory_mb",
        "physics: {min: 3, max: 2}": "min 3 is more than max 2",
        "physics: {cpus: 0}": "physics: cpus is 0, .*: an actor would hold nothing; leave cpus out",
    }.items():
        path.write_text(text)
        with pytest.raises(ConfigError, match=says):
            load_pools(path, Config())
