"""What `tableverse submit` hands to a cluster, and what it refuses before it asks one."""

import sys

import pytest

from tableverse_factory.cli.submit import _stage_files, build_command
from tableverse_factory.core.errors import BuildError
from workers.executors.ray_jobs import IncrementalLog, get_exit_code, make_job_id

NOBODY, POOLS = "http://127.0.0.1:1", "misspelt.yaml"


@pytest.fixture(autouse=True)
def _own_environment(monkeypatch):
    """The client speaks to Ray through the environment; other tests keep theirs."""
    monkeypatch.setenv("RAY_API_SERVER_ADDRESS", NOBODY)
    monkeypatch.setenv("RAY_AUTH_MODE", "disabled")


def test_every_attempt_has_an_id_of_its_own():
    first = make_job_id("s3://bucket/My Data", [])
    assert first == "tableverse-s3-bucket-my-data-1"
    taken = [first, "tableverse-s3-bucket-my-data-9", "tableverse-other-44", "raysubmit_x"]
    assert make_job_id("s3://bucket/My Data", taken) == "tableverse-s3-bucket-my-data-10"


def test_ids_are_short_and_plain_whatever_the_path():
    for out in ["/" + "long/" * 100 + "out", "/üñí/☃", "s3://b/a;rm -rf $HOME"]:
        job = make_job_id(out, [])
        assert len(job) < 60
        assert set(job) <= set("abcdefghijklmnopqrstuvwxyz0123456789-")


@pytest.mark.parametrize(
    ("status", "code", "expected"),
    [("SUCCEEDED", 0, 0), ("FAILED", 3, 3), ("FAILED", None, 1), ("FAILED", -9, 137), ("STOPPED", None, 143)],
)
def test_the_exit_code_is_that_of_the_build(status, code, expected):
    assert get_exit_code(status, code) == expected


@pytest.mark.parametrize("cuts", [(), (3,), (3, 1, 5), (9, 9, 0)])
def test_a_broken_connection_neither_repeats_nor_loses_a_line_of_the_log(cuts):
    log, said = "one\ntwo\nthree\n", []
    ear = IncrementalLog(said.append)
    for cut in (*cuts, len(log)):
        ear.begin()
        for start in range(0, cut, 2):
            ear.write(log[start : min(start + 2, cut)])
    assert "".join(said) == log


def test_the_job_runs_the_build_that_was_asked_for():
    command = build_command("images.parquet", "s3://b/out", ["--set", "run.seed=7", "--workers", "64"])
    assert command == ["tableverse", "build", "images.parquet", "s3://b/out", "--executor", "ray", *command[6:]]
    assert command[6:] == ["--set", "run.seed=7", "--workers", "64"]


def test_stages_that_are_added_are_part_of_the_job():
    command = build_command("images.parquet", "s3://b/out", ["--stages", "+trajectories", "--from", "trajectories"])
    assert command[6:] == ["--stages", "+trajectories", "--from", "trajectories"]


def test_files_that_are_here_travel_and_others_stay_as_they_are(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / "images.parquet").write_bytes(b"rows")
    (tmp_path / "run.yaml").write_text("run: {seed: 7}")
    command = build_command("deep/images.parquet", "/shared/out", ["--config=run.yaml", "--set", "run.seed=8"])
    with _stage_files(command, None) as (sent, folder):
        assert sent[2:] == ["images.parquet", "/shared/out", "--executor", "ray", "--config=run.yaml", *command[-2:]]
        assert sorted(path.name for path in type(tmp_path)(folder).iterdir()) == ["images.parquet", "run.yaml"]
        assert (type(tmp_path)(folder) / "images.parquet").read_bytes() == b"rows"
    (tmp_path / "images.parquet").write_bytes(b"rows")
    (tmp_path / "p.yaml").write_text("{}")
    command = build_command("images.parquet", "/shared/out", ["--config", "run.yaml", "--pools", "p.yaml"])
    with _stage_files(command, None) as (sent, folder):
        assert sent == command
        names = sorted(path.name for path in type(tmp_path)(folder).iterdir())
        assert names == ["images.parquet", "p.yaml", "run.yaml"]
    there = build_command("/shared/images.parquet", "/shared/out", ["--config", "s3://b/run.yaml"])
    with _stage_files(there, None) as (sent, folder):
        assert (sent, folder) == (there, None)
    with (
        pytest.raises(BuildError, match=r"gone\.parquet is not here"),
        _stage_files(["t", "build", "gone.parquet"], None),
    ):
        pass


def test_words_that_name_a_file_here_by_chance_stay_as_they_are(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("64", "build.prom", "rectify"):
        (tmp_path / name).write_text("something else")
    options = ["--workers", "64", "--limit", "64", "--metrics", str(tmp_path / "build.prom"), "--from", "rectify"]
    command = build_command("s3://b/images.parquet", "s3://b/out", options)
    with _stage_files(command, None) as (sent, folder):
        assert (sent, folder) == (command, None)


@pytest.mark.parametrize(
    ("options", "code", "says"),
    [
        (["--", "--wrokers", "3"], 2, "no option --wrokers; did you mean --workers?"),
        (["--", "--workers", "0"], 2, "--workers: '0' should be greater"),
        (["--", "--executor", "local"], 1, "leave --executor out"),
        (["--", "--address", "auto"], 1, "give --address before the --"),
        (["--env", "NO_SUCH_VARIABLE_HERE"], 1, "--env NO_SUCH_VARIABLE_HERE: there is no such variable here"),
        (["--working-dir", "nowhere"], 1, "--working-dir nowhere is no folder"),
        (["--address", "ray://head:10001"], 1, "give the head's port for jobs, e.g. http://head:8265"),
        (["--address", "http://me:hush@head:8265"], 1, "--address: an address holds no user, password or query"),
        (["--address", "me:hush@head:8265"], 1, "give the head's port for jobs, e.g. http://head:8265"),
        (["--", "--set", "run.sed=7"], 1, "did you mean run.seed?"),
        (["--", "--pools", POOLS], 1, "did you mean perception?"),
        (["--", "--config", POOLS], 1, "unknown key 'percepton'"),
        ([], 1, f"the jobs of {NOBODY} cannot be used: "),
        ([], 1, "give the head's port for jobs, e.g. http://head:8265"),
    ],
)
def test_what_cannot_work_is_refused_in_one_line(tableverse, tmp_path, monkeypatch, options, code, says):
    monkeypatch.chdir(tmp_path)
    (tmp_path / POOLS).write_text("percepton: {}")
    answer = tableverse("submit", "/shared/images.parquet", "/shared/out", "--address", NOBODY, *options)
    assert answer.code == code
    assert says in " ".join(answer.err.split())
    assert "hush" not in answer.err
    assert "Traceback" not in answer.err


def test_without_rays_job_client_it_says_what_to_install(tableverse, monkeypatch):
    monkeypatch.setitem(sys.modules, "aiohttp", None)
    answer = tableverse("submit", "/shared/images.parquet", "/shared/out")
    error, advice = answer.err.splitlines()
    assert error == "error: submitting needs Ray's job client: pip install 'tableverse-factory[cluster]'"
    assert advice.startswith("help: docs/troubleshooting.md#")
