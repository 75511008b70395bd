"""kill -9 of the driver, of actors and of sandboxes at random moments: the bytes of an undisturbed build, always."""

import random
import time
from collections import Counter
from pathlib import Path

import numpy as np
import psutil
import pytest

from tableverse_factory.dataset.journals import WORK
from tableverse_factory.evaluation.bench.build_family import DRIVER, choose_victim, list_family
from tests.helpers.builds import build, digests, finish, kill, scenes, start, wait_until, write_manifest
from tests.helpers.processes import command_of, is_alive, kill_if_alive
from workers.progress.build_state import read_build_state

RUN = {"deadline_s": 120.0, "shard_size": 8}
NAMES = ("burn_0.03", "burn_0.06", "fine", "burn_0.04", "empty", "burn_0.05", "fell", "sad")
LIMIT_S = 300.0


def _whole(folder: Path, n_scenes: int) -> tuple[Path, dict[str, str]]:
    """A manifest, and the hashes of its build in one process that nobody disturbed."""
    manifest = write_manifest(folder / "images.parquet", [NAMES[i % len(NAMES)] for i in range(n_scenes)])
    build(manifest, folder / "whole", **RUN)
    return manifest, digests(folder / "whole")


@pytest.mark.slow
@pytest.mark.parametrize(("n_scenes", "kills"), [(60, 3), (200, 20)], ids=["short", "long"])
def test_whatever_kills_the_driver_and_however_often_the_bytes_are_the_same(tmp_path, n_scenes, kills):
    manifest, expected = _whole(tmp_path, n_scenes)
    out, rng = tmp_path / "out", random.Random(kills)
    moments = sorted(rng.sample(range(n_scenes - 20), kills))
    for moment in moments:
        process = start(manifest, out, "ray", 2, **RUN)
        family = _die_somewhere(process, out, moment, rng)
        assert process.poll() is None, "a build that is done before it is killed proves nothing"
        kill(process)
        wait_until(lambda family=family: not any(map(is_alive, family)), LIMIT_S)
    code, errors = finish(start(manifest, out, "ray", 2, **RUN), LIMIT_S)
    assert code == 0, errors
    _same(out, expected, n_scenes)


@pytest.mark.slow
def test_twenty_killed_actors_and_sandboxes_cost_nothing_but_time(tmp_path):
    n_scenes, kills = 200, 20
    manifest, expected = _whole(tmp_path, n_scenes)
    out, rng, hits = tmp_path / "out", np.random.default_rng(kills), Counter()
    process = start(manifest, out, "ray", 2, **RUN)
    for number in range(kills):
        moment = 9 * number + rng.integers(5)  # between two kills other scenes end, so none is hit each time
        wait_until(lambda moment=moment: _accounted(out) >= moment, LIMIT_S)
        time.sleep(rng.uniform(0.0, 0.05))
        wait_until(lambda: _kill_worker(process.pid, hits, rng), LIMIT_S)
    code, errors = finish(process, LIMIT_S)
    assert code == 0, errors
    _same(out, expected, n_scenes)


@pytest.mark.slow  # test_ray_build.py kills actors; tests/workers/state stops commits
def test_an_actor_killed_in_the_middle_of_a_commit_costs_nothing(tmp_path):
    manifest = write_manifest(tmp_path / "images.parquet", ["bulky"] * 6)
    run = {"memory_mb": 2000, "shard_size": 3}
    build(manifest, tmp_path / "whole", **run)
    out, killed = tmp_path / "out", 0
    process = start(manifest, out, "ray", 2, **run)
    while process.poll() is None and killed < 3:
        staging = [*(out / WORK).glob("*.staging/mjcf.tar*")]
        writers = [its for its in psutil.process_iter() if staging and "stage_shard" in command_of(its)]
        for writer in writers:
            killed += kill_if_alive(writer)
        time.sleep(0.005)
    code, errors = finish(process, LIMIT_S)
    assert code == 0, errors
    assert killed
    assert digests(out) == digests(tmp_path / "whole")


def _die_somewhere(process, out: Path, moment: int, rng: random.Random) -> list[psutil.Process]:
    """Waits for a moment: mostly soon after so many scenes are accounted for, sometimes while the build starts.

    Returns:
        The processes below the driver.
    """
    if rng.random() < 0.25:
        time.sleep(rng.uniform(0.0, 4.0))
    else:
        wait_until(lambda: process.poll() is not None or _accounted(out) >= moment, LIMIT_S)
        time.sleep(rng.uniform(0.0, 0.1))
    return psutil.Process(process.pid).children(recursive=True)


def _same(out: Path, expected: dict[str, str], n_scenes: int) -> None:
    ids = [row["scene_id"] for row in scenes(out)]
    assert ids == [f"scene_{i:03d}" for i in range(n_scenes)], "a scene is missing or there twice"
    assert digests(out) == expected


def _kill_worker(driver: int, hits: Counter[int], rng: np.random.Generator) -> bool:
    """Kills an actor, or the child of its sandbox; False if there was none."""
    victim = choose_victim([member for member in list_family(driver) if member.kind != DRIVER], hits, rng)
    return victim is not None and victim.kill()


def _accounted(out: Path) -> int:
    return read_build_state(out).scenes.num_rows if (out / "run.json").exists() else 0
