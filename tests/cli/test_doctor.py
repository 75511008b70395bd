"""The doctor says what is missing and what to do, and is not killed by what it examines."""

import json
import sys
import tomllib
from pathlib import Path

import pytest

from tableverse_factory.cli import doctor_checks
from tests.helpers.paths import ROOT


@pytest.mark.slow
def test_this_machine_is_ready(tableverse):
    """Takes a while: Ray is started."""
    answer = tableverse("doctor", "--json")
    found = json.loads(answer.out)
    assert found["ready"] == (answer.code == 0)
    for check in found["checks"]:
        assert check["found"]
        assert check["ok"] or check["advice"], check["name"]
    assert found["ready"] == all(check["ok"] for check in found["checks"] if check["required"])


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("code", "found"),
    [
        ("import ctypes; ctypes.string_at(0)", "exit code"),
        ("import nosuchlibrary", "No module named 'nosuchlibrary'"),
        ("raise SystemExit('\x1b[2Jno')", r"\x1b[2Jno"),
        ("import time; time.sleep(60)", "no answer within"),
    ],
)
def test_whatever_crashes_or_hangs_is_a_finding(monkeypatch, code, found):
    monkeypatch.setattr(doctor_checks, "SCRIPT_TIMEOUT_S", 2.0)
    check = doctor_checks._check_script("trial", code, "do this")
    assert not check.ok
    assert found in check.found
    assert check.advice == "do this"


@pytest.mark.heavy
def test_a_renderer_that_needed_a_setting_says_which(monkeypatch):
    monkeypatch.setattr(doctor_checks, "_GL_RENDERER", "import os; print('by', os.environ['MUJOCO_GL'])")
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    assert doctor_checks._check_mujoco_renderer().found == "by osmesa"
    monkeypatch.delenv("MUJOCO_GL")
    assert doctor_checks._check_mujoco_renderer().found == "by egl with MUJOCO_GL=egl, which is not set here"
    monkeypatch.setattr(doctor_checks, "_GL_RENDERER", "raise SystemExit('no driver')")
    check = doctor_checks._check_mujoco_renderer()
    assert (check.ok, check.found) == (False, "no driver")


@pytest.mark.heavy
def test_what_works_needs_no_advice():
    assert doctor_checks._check_script("trial", "print('fine')", "do this") == doctor_checks.Check(
        "trial", True, True, "fine", ""
    )


def test_a_missing_library_names_its_package(monkeypatch):
    monkeypatch.setattr(doctor_checks, "SYSTEM_LIBRARIES", {"libnosuch.so.9": "libnosuch9"})
    (check,) = doctor_checks._check_libraries()
    assert (check.required, check.ok, check.advice) == (True, False, "sudo apt-get install libnosuch9")


def test_a_cache_that_is_no_folder_is_a_finding(tmp_path):
    (tmp_path / "file").write_text("x")
    check = doctor_checks._check_writable(tmp_path / "file" / "cache")
    assert not check.ok
    assert "TABLEVERSE_CACHE" in check.advice
    assert doctor_checks._check_writable(tmp_path / "new" / "cache").ok


def test_a_full_disk_is_a_finding(monkeypatch, tmp_path):
    assert doctor_checks._check_free_space("disk", tmp_path / "not" / "there" / "yet").found.endswith("free")
    monkeypatch.setattr(doctor_checks, "MIN_FREE_BYTES", 2**70)
    assert not doctor_checks._check_free_space("disk", tmp_path).ok


@pytest.mark.heavy
def test_trials_are_run_by_this_python():
    assert Path(doctor_checks._check_script("trial", "import sys; print(sys.executable)", "").found) == Path(
        sys.executable
    )


def test_every_extra_is_named_with_what_it_gives(monkeypatch):
    """Those of pyproject.toml, but for who changes this code; what is missing comes with the command that brings it."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    assert set(doctor_checks.EXTRAS) == set(extras) - {"dev", "docs"}
    for extra, (packages, _) in doctor_checks.EXTRAS.items():
        required = " ".join(extras[extra])
        assert extra == "cluster" or all(package in required for package in packages), extra
    monkeypatch.setattr(doctor_checks, "_find_version", lambda package: None)
    for extra, check in zip(doctor_checks.EXTRAS, doctor_checks._check_extras(), strict=False):
        assert (check.required, check.ok) == (False, False)
        assert f"pip install 'tableverse-factory[{extra}]'" in check.advice
