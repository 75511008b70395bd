"""What the page on troubleshooting quotes is said by a real command: here, or in the test that is named."""

import os
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from tests.helpers.captures_on_disk import huge_png, write_capture, write_layout, write_picture
from tests.helpers.paths import ROOT
from tests.integration.docs.test_troubleshooting import LEAST_CHARS, quoted

Run = Callable[..., tuple[int, str, str]]

FIXED = "<mujoco><worldbody><geom type='plane' size='1 1 .1'/></worldbody></mujoco>"
LEAVES = "<mujoco><asset><mesh name='m' file='../m.obj'/></asset><worldbody/></mujoco>"


def nothing_found(run: Run, home: Path) -> str:
    (home / "empty").mkdir()
    return run("manifest", home / "empty", "--out", home / "images.parquet")[2]


def layout_for_verify(run: Run, home: Path) -> str:
    return run("verify", write_layout(home / "layout.json"))[2]


def nothing_moves(run: Run, home: Path) -> str:
    return verified(run, home, FIXED)


def leads_outside(run: Run, home: Path) -> str:
    return verified(run, home, LEAVES)


def verified(run: Run, home: Path, text: str) -> str:
    (home / "scene.xml").write_text(text)
    return "".join(run("verify", home / "scene.xml")[1:])


def without_curobo(run: Run, home: Path) -> str:
    planner = ("--set", "trajectories.planner=curobo")
    return run("build", home / "images.parquet", home / "out", "--stages", "+trajectories", *planner)[2]


def without_a_library(_: Run, home: Path) -> str:
    """As somebody who is not root, with a Python that lacks its venv: it stands for any package that is not there."""
    (home / "id").write_text("#!/bin/sh\necho 1000\n")
    (home / "id").chmod(0o755)
    line = [str(ROOT / "deploy" / "system-libraries.sh")]
    instead = {"PATH": f"{home}{os.pathsep}{os.environ['PATH']}", "PYTHON": "false"}
    return subprocess.run(line, env={**os.environ, **instead}, capture_output=True, text=True).stderr


COMMANDS: dict[str, Callable[[Run, Path], str]] = {
    "error: system libraries are missing; run: sudo apt-get install …": without_a_library,
    "error: nothing found in …": nothing_found,
    "error: … nothing there can be verified": layout_for_verify,
    "nothing to certify: no body has a free joint": nothing_moves,
    "… which lies outside …": leads_outside,
    "trajectories.planner=curobo needs …": without_curobo,
}

REJECTED = {
    "depth_not_16_bit": lambda home: write_capture(home, 1, depth=np.zeros((24, 32), np.uint8)),
    "depth_size_differs": lambda home: write_capture(home, 2, depth=np.ones((9, 9), np.uint16)),
    "bad_intrinsics": lambda home: write_capture(home, 3, fx=-1.0),
    "picture_too_large": lambda home: (write_capture(home, 4) / "color.png").write_bytes(huge_png(60_000, 60_000)),
    "bad_layout": lambda home: write_layout(home / "layout.json", labl="mug"),
    "missing_mesh": lambda home: write_layout(home / "layout.json", mesh="gone.obj"),
    "bad_mesh_path": lambda home: write_layout(home / "layout.json", mesh="/etc/passwd"),
}
"""Inputs that `tableverse manifest` rejects, by the reason."""

DROPPED = ("content_changed", "no_objects", "no_table", "no_table_plane")
"""By one build of four inputs."""

AFTERWARDS = (
    "… was begun as another build",
    "error: no scene may be passed on as …",
    "… no finished scene to verify …",
)
"""What this build says when it is asked for more."""

ELSEWHERE = {
    "picture_too_narrow": "tests/stages/observe/depth/test_depth_models.py",
    "no_recorded_depth": "tests/stages/observe/depth/test_rgb_image.py",
    "bad_mesh": "tests/sources/test_mesh_file.py",
    "not_at_rest": "tests/stages/test_settle.py",
    "object_fell": "tests/stages/test_settle.py",
    "colliding": "tests/evaluation/test_scene_audit.py",
    "error: … refuses … (HTTP …)": "tests/models/remote/test_client.py",
    "… is no ONNX file: …": "tests/integration/builds/test_missing_models.py",
    "… is not on this machine and the hub cannot be reached: …": "tests/models/local/test_hf_weights.py",
    "… is not set where the stages run": "tests/models/remote/test_client.py",
    "… is left for a later run: …": "tests/integration/builds/test_trajectories_build.py",
    "… scenes in a row were left. Run the same command to go on": "tests/integration/builds/test_trajectories_build.py",
    "… that has to be given": "tests/delivery/episodes/test_robot.py",
    "… has to be given with --robot": "tests/delivery/episodes/test_robot.py",
    "detector_answer_invalid": "tests/stages/perceive/vlm/test_detector.py",
    "detector_answer_refused": "tests/stages/perceive/vlm/test_detector.py",
    "no_table_detected": "tests/stages/perceive/vlm/test_detector.py",
    "no turn to ask came in time: asking.max_parallel is …": "tests/models/remote/test_rate_limiter.py",
    "turns to ask cannot be kept in …": "tests/models/remote/test_rate_limiter.py",
    "the budget is spent: …": "tests/integration/builds/test_asking_build.py",
    "error: --max-usd needs the price of …": "tests/integration/builds/test_asking_build.py",
    "what is spent cannot be written down in …": "tests/workers/driver/test_budget.py",
    "the mesh process … does not …: …": "tests/stages/place/mesh_service/test_process.py",
    "… objects in a row the mesh process failed twice: …": "tests/stages/place/mesh_service/test_process.py",
    "the mesh process made none of … meshes: …": "tests/stages/place/mesh_service/test_process.py",
    "judge_answer_invalid": "tests/stages/curate/test_model.py",
    "judge_answer_refused": "tests/stages/curate/test_model.py",
    "timeout": "tests/workers/sandbox/test_parent.py",
    "crash": "tests/workers/sandbox/test_parent.py",
    "out_of_memory": "tests/workers/sandbox/test_parent.py",
    "… was begun with the stage …": "tests/integration/builds/test_trajectories_build.py",
    "… is not finished: …": "tests/integration/builds/test_trajectories_build.py",
    "… the manifest cannot be restored …": "tests/integration/builds/test_trajectories_build.py",
    "… bytes hold no whole result …": "tests/workers/state/test_journal.py",
    "… finished scenes do not read …": "tests/integration/builds/test_growing_dataset.py",
    "damaged, as by a loss of power: …": "tests/integration/builds/test_growing_dataset.py",
    "… not built yet": "tests/evaluation/test_verify.py",
    "… is being written by …": "tests/integration/s3/test_store_builds.py",
    "… there is no bucket …": "tests/core/storage/test_files.py",
    "… no credentials: …": "tests/core/storage/test_files.py",
    "… access denied …": "tests/core/storage/test_files.py",
    "… the store does not answer …": "tests/integration/s3/test_store_builds.py",
    "… the store answers …": "tests/integration/s3/test_store_builds.py",
    "… has lost the right to write it …": "tests/workers/state/test_lease.py",
}
"""What takes a server, a crash or a build of real scenes, and the test that provokes it."""


def test_every_quoted_message_is_provoked_by_a_test() -> None:
    sentences = {text for text in quoted() if " " in text}  # the codes are literals of the sources
    assert sentences <= {*COMMANDS, *AFTERWARDS, *ELSEWHERE}


@pytest.mark.parametrize("message", COMMANDS)
def test_a_command_says_it(message: str, run: Run, tmp_path: Path) -> None:
    told = " ".join(COMMANDS[message](run, tmp_path).split())
    pieces = [piece.strip() for piece in message.removeprefix("error: ").split("…")]
    assert [piece for piece in pieces if piece not in told] == [], told


def test_the_manifest_rejects_with_these_reasons(run: Run, tmp_path: Path) -> None:
    for reason, make in REJECTED.items():
        make(tmp_path / "in" / reason)
    run("manifest", tmp_path / "in", "--out", tmp_path / "images.parquet")
    rows = pq.read_table(tmp_path / "images.parquet").to_pylist()
    assert {row["rejected"] for row in rows if row["rejected"]} == set(REJECTED)
    assert all(row["rejected_detail"] for row in rows if row["rejected"])


def test_a_build_drops_with_these_reasons(run: Run, tmp_path: Path) -> None:
    write_picture(tmp_path / "in" / "alone.png", 1)
    write_capture(tmp_path / "in" / "bare", 2)
    noise = np.random.default_rng(0).integers(300, 4000, (24, 32)).astype(np.uint16)
    write_capture(tmp_path / "in" / "noise", 5, depth=noise)
    changed = write_capture(tmp_path / "in" / "changed", 3)
    run("manifest", tmp_path / "in", "--out", tmp_path / "images.parquet")
    write_picture(changed / "color.png", 4)
    line = ("build", tmp_path / "images.parquet", tmp_path / "out", "--executor", "local")
    assert run(*line)[0] == 0
    reasons = pq.read_table(tmp_path / "out" / "scenes")["reason"].to_pylist()
    assert sorted(reasons) == list(DROPPED)
    code, _, err = run(*line, "--set", "settle.max_time_s=10")
    assert code == 1
    assert AFTERWARDS[0].strip("… ") in err
    for message, command in zip(AFTERWARDS[1:], (("export", tmp_path / "dest"), ("verify",)), strict=True):
        code, _, err = run(command[0], tmp_path / "out", *command[1:])
        assert code == 1
        assert message.removeprefix("error: ").strip("… ") in err


@pytest.mark.parametrize("message", ELSEWHERE)
def test_the_test_that_is_named_speaks_of_it(message: str) -> None:
    """Its longest piece between two `…`, as it stands; a regular expression writes a dot as `\\.`."""
    text = (ROOT / ELSEWHERE[message]).read_text().replace("\\.", ".")
    longest = max((piece.strip() for piece in message.removeprefix("error: ").split("…")), key=len)
    assert len(longest) > LEAST_CHARS
    assert longest in text
