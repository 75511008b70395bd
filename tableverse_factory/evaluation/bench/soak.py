"""Soak test of builds: driver, actors and sandboxes are killed again and again, and the bytes must stay the same.

Builds run as the command `tableverse build`, in processes of their own, which are found, measured and killed from
outside.
"""

import os
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import psutil

from tableverse_factory.core.cache_dir import CACHE_VARIABLE
from tableverse_factory.core.errors import BuildError, InputError
from tableverse_factory.core.file_hash import hash_file
from tableverse_factory.core.text import pluralize
from tableverse_factory.dataset.dataset import open_dataset
from tableverse_factory.evaluation.bench.build_family import DRIVER, choose_victim, list_family
from tableverse_factory.evaluation.bench.process_memory import KindMemory, MemoryLog
from tableverse_factory.evaluation.verify import verify_scenes
from tableverse_factory.sources.manifest import create_manifest
from tableverse_factory.sources.synthetic.synthesize import check_output_folder, synthesize_captures

MAX_GROWTH = 0.1  # share of its memory that a process may gain over the second half of its life
CAPTURES, MANIFEST, UNDISTURBED, DISTURBED = "captures", "images.parquet", "undisturbed", "disturbed"
_OWN = frozenset({CAPTURES, MANIFEST, UNDISTURBED, DISTURBED, "cache", "errors.txt"})
_TABLEVERSE = (sys.executable, "-c", "from tableverse_factory.cli.main import main; main()")
_ENDED = (0, 3)  # exit codes of a build that accounts for all scenes: the bytes tell whether any should have failed
_SAMPLE_S = 1.0
_GONE_S = 120.0  # time in which everything below a killed driver must end [s]
_SLACK = 10  # a disturbed build may take so many times as long as the undisturbed one, and the time of all kills
_LAST_CHARS = 2000
_SHOWN = 5


@dataclass(frozen=True, slots=True)
class SoakPlan:
    """What is built, and how it is disturbed."""

    folder: Path
    scenes: int
    workers: int
    disturbed_s: float  # time after which no kill and no further build follow [s]
    kill_every_s: float
    seed: int  # of the captures and of the kills


@dataclass(frozen=True, slots=True)
class SoakReport:
    """Result of a soak test."""

    builds: int  # disturbed ones that completed
    kills: Mapping[str, int]  # by kind of process
    memory: tuple[KindMemory, ...]
    problems: tuple[str, ...]  # empty if all is well


class _Killer:
    """Kills a random process of a build every so many seconds, until a time has come."""

    def __init__(self, plan: SoakPlan, show: Callable[[str], None]) -> None:
        self._rng, self._every_s, self._show = np.random.default_rng(plan.seed), plan.kill_every_s, show
        self.until = time.monotonic() + plan.disturbed_s
        self._next = time.monotonic() + plan.kill_every_s
        self._hits: Counter[int] = Counter()
        self.kills: Counter[str] = Counter()

    def strike(self, driver: int) -> None:
        """Kill a process if it is time."""
        if not self._next <= time.monotonic() < self.until:
            return
        victim = choose_victim(list_family(driver), self._hits, self._rng)
        if victim is not None and victim.kill():
            self._show(f"killed: {victim.kind}")
            self.kills[victim.kind] += 1
            self._next = time.monotonic() + self._every_s


def run_soak(plan: SoakPlan, show: Callable[[str], None] = lambda _: None) -> SoakReport:
    """Build undisturbed once, then disturbed until the time is over; compare, verify and measure.

    The first disturbed build that is wrong ends the test and stays in the folder. Captures stay for the next test.

    Args:
        plan: What is built, and how it is disturbed.
        show: Called with a line before each step.

    Raises:
        InputError: if the folder holds other files.
        BuildError: if the undisturbed build fails.
    """
    ids = _make_inputs(plan, show)
    memory, whole = MemoryLog(), plan.folder / UNDISTURBED
    show(f"building {pluralize(plan.scenes, 'scene')} undisturbed")
    started = time.monotonic()
    _run_build(plan, whole, memory)
    limit_s = _SLACK * (time.monotonic() - started) + plan.disturbed_s
    expected = hash_dataset(whole)
    problems = list(find_unaccounted(whole, ids))
    killer = _Killer(plan, show)
    builds, out = 0, plan.folder / DISTURBED
    while not problems and (builds == 0 or time.monotonic() < killer.until):
        show(f"building disturbed, number {builds + 1}")
        try:
            _run_build(plan, out, memory, killer, limit_s)
        except BuildError as error:
            problems.append(str(error))
            break
        builds += 1
        problems += [*find_unaccounted(out, ids), *compare_digests(expected, hash_dataset(out))]
    show("verifying")
    problems += find_unverified(out if builds else whole, plan.workers)
    summary = memory.summarize()
    return SoakReport(builds, dict(killer.kills), summary, (*problems, *find_growth(summary)))


def hash_dataset(out: Path) -> dict[str, str]:
    """Compute the SHA-256 of every file of a dataset except timings and what a build keeps for itself (`.…`)."""
    digests = {}
    for path in sorted(out.rglob("*")):
        parts = path.relative_to(out).parts
        if path.is_file() and parts[0] != "timings" and not parts[0].startswith("."):
            digests["/".join(parts)] = hash_file(path)
    return digests


def compare_digests(expected: Mapping[str, str], found: Mapping[str, str]) -> list[str]:
    """Name the files that differ from those of the undisturbed build, or are in one of the two only."""
    names = sorted(expected.keys() | found.keys())
    different = [name for name in names if expected.get(name) != found.get(name)]
    return [f"{_list_some(different)}: not the bytes of the undisturbed build"] if different else []


def find_unaccounted(out: Path, ids: Collection[str]) -> list[str]:
    """Find scenes of the manifest without a row of their own in scenes/."""
    rows = Counter(open_dataset(out).scenes.to_table(columns=["scene_id"]).column(0).to_pylist())
    wrong = sorted(scene_id for scene_id in rows.keys() | set(ids) if rows[scene_id] != (scene_id in ids))
    return [f"{_list_some(wrong)}: missing in {out}/scenes, there twice, or unknown"] if wrong else []


def find_unverified(out: Path, jobs: int) -> list[str]:
    """Verify all finished scenes again; return the problems of those that fail."""
    try:
        audits = [audit for audit in verify_scenes(str(out), jobs) if not audit.ok]
    except InputError as error:
        return [str(error)]
    return [f"{audit.scene_id}: {'; '.join(audit.problems)[:500] or 'not at rest or colliding'}" for audit in audits]


def find_growth(memory: Collection[KindMemory]) -> list[str]:
    """Name the kinds of processes of which one grew by more than `MAX_GROWTH`."""
    grown = [kind for kind in memory if kind.growth > MAX_GROWTH]
    return [f"a process grew by {kind.growth:.0%} over the second half of its life: {kind.kind}" for kind in grown]


def _make_inputs(plan: SoakPlan, show: Callable[[str], None]) -> frozenset[str]:
    """Make the captures and their manifest; return the ids of the scenes. Builds of an earlier test are removed."""
    check_output_folder(plan.folder, lambda path: path.name in _OWN)
    show(f"making {pluralize(plan.scenes, 'capture')}")
    folders = synthesize_captures(plan.folder / CAPTURES, plan.scenes, plan.seed)
    for name in _OWN - {CAPTURES}:
        path = plan.folder / name
        shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
    manifest = create_manifest([str(folder) for folder in folders], str(plan.folder / MANIFEST))
    return frozenset(row.scene_id for row in manifest.rows)


def _run_build(
    plan: SoakPlan, out: Path, memory: MemoryLog, killer: _Killer | None = None, limit_s: float = float("inf")
) -> None:
    """Run a build from nothing to its end; where the driver is killed, the same command goes on.

    Raises:
        BuildError: if the driver ends with an error, or the build takes longer than `limit_s`, or processes outlive
            their driver.
    """
    if out.exists():
        shutil.rmtree(out)
    until, process = time.monotonic() + limit_s, _start_driver(plan, out)
    try:
        while process.poll() is None:
            if time.monotonic() > until:
                raise BuildError(f"{out} is not complete after {limit_s:.0f} s")
            below = _list_below(process.pid)
            for member in list_family(process.pid):
                memory.sample(member.kind, member.process)
            kills = killer.kills[DRIVER] if killer else 0
            if killer is not None:
                killer.strike(process.pid)
                if killer.kills[DRIVER] > kills and process.wait() == -signal.SIGKILL:
                    _wait_until_gone(below)
                    process = _start_driver(plan, out)
            time.sleep(_SAMPLE_S)
        if process.returncode not in _ENDED:
            text = (plan.folder / "errors.txt").read_text(errors="replace")[-_LAST_CHARS:]
            raise BuildError(f"the build of {out} ended with {process.returncode}: {text}")
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()


def _start_driver(plan: SoakPlan, out: Path) -> subprocess.Popen[bytes]:
    folder = plan.folder.absolute()
    options = ("--executor", "ray", "--workers", str(plan.workers))
    quiet = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", CACHE_VARIABLE: str(folder / "cache" / out.name)}
    with (folder / "errors.txt").open("wb") as errors:
        return subprocess.Popen(
            [*_TABLEVERSE, "build", str(folder / MANIFEST), str(out.absolute()), *options],
            stdout=subprocess.DEVNULL,
            stderr=errors,
            env={**os.environ, **quiet},
            start_new_session=True,  # Ctrl-C is for the test, which then ends the build
        )


def _list_below(driver: int) -> list[psutil.Process]:
    try:
        return psutil.Process(driver).children(recursive=True)
    except psutil.NoSuchProcess:
        return []


def _wait_until_gone(processes: list[psutil.Process]) -> None:
    until = time.monotonic() + _GONE_S
    while alive := list(filter(_is_alive, processes)):
        if time.monotonic() > until:
            raise BuildError(f"{alive[0]} and {len(alive) - 1} more still run {_GONE_S:.0f} s after their driver")
        time.sleep(0.1)


def _is_alive(process: psutil.Process) -> bool:
    try:
        return process.is_running() and process.status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def _list_some(names: list[str]) -> str:
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return ", ".join(names[:_SHOWN]) + more
