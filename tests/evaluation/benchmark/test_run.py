"""Runs: the same bytes from any number of processes and after a kill; a policy's failures are rows."""

import fcntl
import hashlib
import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

import pytest

from tableverse_factory import open_dataset
from tableverse_factory.core.errors import BuildError, InputError
from tableverse_factory.evaluation.benchmark.benchmark import Benchmark
from tableverse_factory.evaluation.benchmark.episode_processes import EpisodeProcesses, PlayPlan
from tableverse_factory.evaluation.benchmark.journal import open_journal
from tableverse_factory.evaluation.benchmark.load_policy import PolicyName
from tableverse_factory.evaluation.benchmark.policy_server import PolicyServer
from tableverse_factory.evaluation.benchmark.results import ResultsHeader, encode_line, encode_results, read_results
from tableverse_factory.evaluation.benchmark.run import RunSettings, run_benchmark
from tests.helpers.learnable_dataset import write_learnable_dataset
from tests.helpers.paths import ROOT

pytestmark = pytest.mark.heavy

POLICIES = """
import os, time
import numpy as np

class Quick:
    pictures, picture_size = (), (96, 128)

    def reset(self, start):
        self.start, self.rng, self.step = start, np.random.default_rng(start.seed), 0

    def act(self, observation):
        self.step += 1
        if self.step == 5:
            raise RuntimeError("five\\nsteps")
        return self.rng.uniform(-0.1, 0.1, len(self.start.lower))

class Unlucky(Quick):
    def act(self, observation):
        print("this is no output")
        name = self.start.episode_id
        if name == "test_0001":
            return np.full(8, np.nan)
        if name == "test_0000_start":
            os.kill(os.getpid(), 9)
        if name == "test_0000_light":
            time.sleep(600)
        if name == "test_0000_texture":
            return [[0.0]]
        if name == "test_0000_camera":
            raise SystemExit(3)
        return super().act(observation)

class Slow(Quick):
    def act(self, observation):
        time.sleep(0.05)
        return super().act(observation)

class Sly(Quick):
    def reset(self, start):
        from tableverse_factory.evaluation.benchmark.policy import PolicyError

        if start.episode_id == "test_0001":
            raise PolicyError("", "all is well")
        if start.episode_id == "test_0000":
            raise PolicyError("Not a word", "")
        super().reset(start)

class Mortal(Quick):
    def act(self, observation):
        import threading
        threading.Timer(0.3, os._exit, [0]).start()
        raise RuntimeError("soon gone")

class Absent(Quick):
    def __init__(self):
        raise OSError("no weights")
"""


@pytest.fixture(scope="module")
def policies(tmp_path_factory):
    path = tmp_path_factory.mktemp("policies") / "policies.py"
    path.write_text(POLICIES)
    return path


@pytest.fixture(scope="module")
def quick(benchmark, dataset, policies, tmp_path_factory):
    """The results of a run of `Quick` on the episode of training."""
    out = tmp_path_factory.mktemp("quick") / "quick.jsonl"
    rows = run(benchmark, dataset, PolicyName(f"{policies}:Quick"), out, splits=("train",))
    assert [row.episode_id for row in rows] == ["train_0000"]
    return out


@pytest.fixture
def run_command(run):
    """The command line of `tests/conftest.py`: `run` is a run of a policy here."""
    return run


def run(benchmark, dataset, policy, out, **settings):
    return run_benchmark(benchmark, dataset, policy, out, RunSettings(**settings))[1]


@pytest.mark.slow  # the test below adds to a run; builds are killed in the fast run
def test_a_killed_run_goes_on_and_the_number_of_processes_is_not_seen(benchmark, dataset, policies, tmp_path):
    alone, killed = tmp_path / "alone.jsonl", tmp_path / "killed.jsonl"
    name = PolicyName(f"{policies}:Slow")
    run(benchmark, dataset, name, alone, jobs=1)
    file = tmp_path / "benchmark.json"
    file.write_bytes(benchmark.encode())
    arguments = ["--dataset", dataset.path, "--policy", name.name, "--out", str(killed), "--jobs", "1"]
    code = "from tableverse_factory.cli.main import main; main()"
    journal = tmp_path / "killed.jsonl.journal"
    with subprocess.Popen(
        [sys.executable, "-c", code, "benchmark", "run", str(file), *arguments],
        cwd=ROOT,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    ) as process:
        until = time.monotonic() + 120.0
        while time.monotonic() < until and (not journal.exists() or journal.read_bytes().count(b"\n") < 3):
            time.sleep(0.01)
        os.killpg(process.pid, signal.SIGKILL)
    assert not killed.exists()
    done = journal.read_bytes().count(b"\n")
    assert 3 <= done <= len(benchmark.episodes)
    with journal.open("ab") as torn:
        torn.write(b'{"episode_id": "te')
    run(benchmark, dataset, name, killed, jobs=2)
    assert killed.read_bytes() == alone.read_bytes()
    assert not journal.exists()


def test_a_choice_is_run_and_a_wider_one_later_adds_to_it(benchmark, dataset, policies, quick, tmp_path):
    out, name = tmp_path / "some.jsonl", PolicyName(f"{policies}:Quick")
    before = quick.read_bytes()
    out.write_bytes(before)
    rows = run(benchmark, dataset, name, out, axes=("none",))
    assert [row.episode_id for row in rows] == ["train_0000", "test_0000", "test_0001"]
    assert out.read_bytes().startswith(before)
    with pytest.raises(InputError, match="has no episodes of these splits"):
        run(benchmark, dataset, name, out, splits=("validation",))


@pytest.mark.slow  # a process for each kind of failure; the test below shows how they are told
def test_failures_of_a_policy_are_rows_with_reasons(benchmark, dataset, policies, tmp_path, capfd):
    rows = run(benchmark, dataset, PolicyName(f"{policies}:Unlucky"), tmp_path / "u.jsonl", jobs=2, episode_s=15.0)
    assert [row.episode_id for row in rows] == [episode.episode_id for episode in benchmark.episodes]
    found = {row.episode_id: (row.reason, row.detail) for row in rows}
    line = POLICIES.splitlines().index('            raise RuntimeError("five\\nsteps")') + 1
    assert found["test_0000"] == ("policy_error", f"RuntimeError: five steps (policies.py:{line})")
    assert found["test_0001"][0] == "bad_action"
    assert "give 8 finite numbers" in found["test_0001"][1]
    assert found["test_0000_texture"][0] == "bad_action"
    assert found["test_0000_start"] == ("policy_crash", "its process was killed by SIGKILL")
    assert found["test_0000_camera"] == ("policy_crash", "its process ended with 3")
    assert found["test_0000_light"] == ("policy_timeout", "took longer than 15 s")
    assert capfd.readouterr().out == ""


def test_a_run_ends_with_its_reasons_and_where_the_policy_raised(benchmark, dataset, tmp_path, run_command):
    """What a policy says of itself moves no cursor, and a thousand reasons are some lines."""
    folder = tmp_path / "mine"
    folder.mkdir()
    (folder / "__init__.py").write_text("")
    (folder / "helper.py").write_text("import json\n\n\ndef parse():\n    return json.loads('\\x1b[2J')\n")
    policy = tmp_path / "says.py"
    policy.write_text(
        "from mine.helper import parse\n"
        "from tableverse_factory.evaluation.benchmark.policy import PolicyError\n"
        "class Says:\n"
        "    pictures, picture_size = (), (96, 128)\n"
        "    def reset(self, start):\n"
        "        if start.episode_id == 'test_0000': parse()\n"
        "        if start.episode_id == 'test_0001': raise ValueError('[bold]' + '\\x1b[2J' * 500)\n"
        "        raise PolicyError(start.episode_id.replace('0', 'o').replace('1', 'i'), 'no')\n"
        "    def act(self, observation): pass\n"
    )
    file = tmp_path / "benchmark.json"
    file.write_bytes(benchmark.encode())
    arguments = ("--dataset", dataset.path, "--policy", f"{policy}:Says", "--out", tmp_path / "says.jsonl", "--jobs", 1)
    code, text, errors = run_command("benchmark", "run", file, *arguments)
    assert code == 0, errors
    said = text.splitlines()
    assert said[0].startswith("0 of 9 episodes succeed; ")
    assert said[1].split() == ["reason", "episodes", "for", "example"]
    assert "policy_error" in said[2]
    assert text.replace("\n", "").isprintable()
    assert len(said) <= 30
    rows = read_results(tmp_path / "says.jsonl")[1]
    assert rows["test_0000"].detail.endswith(" (mine/helper.py:5)")
    assert rows["test_0000"].detail.startswith("JSONDecodeError: ")
    assert rows["test_0001"].detail.startswith("ValueError: [bold]\\x1b[2J")
    assert rows["test_0001"].detail.endswith("… (says.py:7)")
    assert len(rows["test_0001"].detail) <= 300


def test_a_policy_that_does_not_load_ends_the_run_with_one_line(benchmark, dataset, policies, tmp_path):
    out = tmp_path / "absent.jsonl"
    with pytest.raises(InputError, match="Absent does not load: OSError: no weights") as caught:
        run(benchmark, dataset, PolicyName(f"{policies}:Absent"), out, jobs=2)
    assert caught.value.reason == "bad_policy"
    assert not list(tmp_path.iterdir())


def test_other_scenes_are_refused_before_anything_is_played(benchmark, tmp_path):
    other = write_learnable_dataset(tmp_path / "other", scenes=3, moved=0)
    path = next((other / "mjcf").glob("*0.tar"))
    path.write_bytes(path.read_bytes().replace(b'friction="0.8 0.01 0.004"', b'friction="0.9 0.01 0.004"'))
    with pytest.raises(InputError, match=r"scene s-0 is not the one of the benchmark .* build that again") as caught:
        run(benchmark, open_dataset(other), PolicyName("random"), tmp_path / "r.jsonl")
    assert caught.value.reason == "other_scenes"
    fewer = write_learnable_dataset(tmp_path / "fewer", scenes=2, moved=0)
    with pytest.raises(InputError, match=r"lacks 1 of 3 scenes of the benchmark, e\.g\. s-2"):
        run(benchmark, open_dataset(fewer), PolicyName("random"), tmp_path / "r.jsonl")


def test_results_of_another_run_or_one_under_way_are_not_mixed(benchmark, dataset, quick, tmp_path):
    out = tmp_path / "r.jsonl"
    out.write_bytes(quick.read_bytes())
    with pytest.raises(
        InputError,
        match=r"another run: policy was 'policies\.py:Quick' and is now 'random'; the digest of the policy's code was ",
    ):
        run(benchmark, dataset, PolicyName("random"), out, splits=("train",))
    header, rows = read_results(out)
    other = Benchmark.model_validate(benchmark.model_dump() | {"seed": 5})
    out.write_bytes(encode_results(header.model_copy(update={"benchmark": other.digest}), rows.values()))
    with (
        pytest.raises(InputError, match=rf"run: benchmark was '{other.digest}' and is now "),
        open_journal(out, header),
    ):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["r.jsonl"], "no journal without rows stays"
    with (tmp_path / "r.jsonl.journal").open("ab") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        with pytest.raises(BuildError, match="another process writes these results"), open_journal(out, header):
            pass


@pytest.mark.slow  # two runs of a policy with weights
def test_other_weights_are_named_with_their_digests_and_moved_ones_are_the_same(benchmark, dataset, tmp_path):
    policy, out = tmp_path / "weighed.py", tmp_path / "r.jsonl"
    policy.write_text(POLICIES + "\nclass Weighed(Quick):\n    def __init__(self, weights): pass\n")
    first, moved, other = tmp_path / "first.pt", tmp_path / "moved.pt", tmp_path / "other.pt"
    for path, content in ((first, b"1"), (moved, b"1"), (other, b"2")):
        path.write_bytes(content)
    run(benchmark, dataset, PolicyName(f"{policy}:Weighed", str(first)), out, splits=("train",))
    run(benchmark, dataset, PolicyName(f"{policy}:Weighed", str(moved)), out, splits=("train",))
    with pytest.raises(InputError, match="holds results of another run") as caught:
        run(benchmark, dataset, PolicyName(f"{policy}:Weighed", str(other)), out, splits=("train",))
    old, new = (hashlib.sha256(content).hexdigest()[:12] for content in (b"1", b"2"))
    for words in (f"weights was 'sha256 {old}, ", f" and is now 'sha256 {new}, ", "moved.pt", "other.pt"):
        assert words in str(caught.value)
    assert "code" not in str(caught.value)


def test_a_journal_without_rows_goes_with_its_run_and_one_with_rows_stays(quick, tmp_path):
    out, journal = tmp_path / "r.jsonl", tmp_path / "r.jsonl.journal"
    header, rows = read_results(quick)
    (row,) = rows.values()
    for line in (b"", encode_line(row)):
        with suppress(KeyboardInterrupt), open_journal(out, header) as (file, _):
            assert journal.read_bytes() == encode_line(header)
            file.write(line)
            raise KeyboardInterrupt
        assert journal.exists() == bool(line)
    with suppress(KeyboardInterrupt), open_journal(out, header) as (_, known):
        assert list(known) == [row.episode_id]
        raise KeyboardInterrupt
    assert journal.read_bytes() == encode_line(header) + encode_line(row)
    journal.write_bytes(b"notes of mine\n")
    with pytest.raises(InputError, match="is no results file"), open_journal(out, header):
        pass
    assert journal.read_bytes() == b"notes of mine\n"
    journal.write_bytes(encode_line(header.model_copy(update={"policy": "killed before its first row"})))
    with open_journal(out, header) as (file, known):
        assert (known, journal.read_bytes()) == ({}, encode_line(header))
    assert not journal.exists()


def test_only_one_run_at_a_time_has_the_journal(tmp_path):
    """Also where one opens it while another ends and removes it."""
    out, until = tmp_path / "r.jsonl", time.monotonic() + 1.0
    header = ResultsHeader(
        benchmark="0" * 64, policy="p", policy_digest="0" * 64, privileged=False, pictures=(), picture_size=(96, 128)
    )
    alone, runs = threading.Lock(), []

    def run_again_and_again() -> None:
        while time.monotonic() < until:
            with suppress(BuildError), open_journal(out, header) as (file, _):
                runs.append(is_alone := alone.acquire(blocking=False))
                time.sleep(0.0005)
                if is_alone:
                    alone.release()
                Path(file.name).unlink(missing_ok=True)

    threads = [threading.Thread(target=run_again_and_again) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(runs) > 10
    assert all(runs)


def test_no_word_of_a_policy_makes_a_failure_a_success(benchmark, dataset, policies, tmp_path):
    results = run(
        benchmark, dataset, PolicyName(f"{policies}:Sly"), tmp_path / "sly.jsonl", splits=("test",), axes=("none",)
    )
    found = {row.episode_id: (row.success, row.reason) for row in results if row.axis == "none"}
    assert found["test_0001"] == found["test_0000"] == (False, "policy_error")


@pytest.mark.slow  # a whole run of a policy
def test_a_process_that_ends_between_episodes_costs_none(benchmark, dataset, policies, tmp_path):
    processes = EpisodeProcesses(PlayPlan(benchmark, dataset.path, PolicyName(f"{policies}:Mortal")), 60.0)
    with processes:
        processes.describe_policy()
        first = list(processes.play(benchmark.episodes[:1], 1))
        time.sleep(1.0)
        second = list(processes.play(benchmark.episodes[:1], 1))
    assert [row.reason for row in first + second] == ["policy_error"] * 2


def test_a_served_policy_that_is_gone_ends_the_run_and_loses_no_episode(benchmark, dataset, policies, tmp_path):
    class Fails:
        pictures, picture_size = (), (96, 128)

        def reset(self, start):
            threading.Thread(target=server.shutdown).start()
            raise RuntimeError("first and last")

        def act(self, observation):
            raise NotImplementedError

    out = tmp_path / "served.jsonl"
    with PolicyServer(Fails, 0) as server:
        name = PolicyName(f"http://127.0.0.1:{server.server_port}")

        def serve():
            server.serve_forever(0.02)
            server.server_close()

        thread = threading.Thread(target=serve)
        thread.start()
        with pytest.raises(InputError, match="start the policy again, and the same command goes on"):
            run(benchmark, dataset, name, out, jobs=1)
        thread.join()
    assert not out.exists()
    journal = (tmp_path / "served.jsonl.journal").read_text()
    assert journal.count("policy_error") == 1
