"""`verify --engine warp`: rest and contacts in an engine that did not settle the scenes."""

import json
from dataclasses import replace

import pytest

from tableverse_factory.evaluation.engine_drift import EngineDrift
from tableverse_factory.evaluation.verify_engine import audit_engine
from tests.helpers.learnable_dataset import write_learnable_dataset

STILL = EngineDrift("s-0", 1e-5, 1e-4, 0.0, 12, 2e-5, overflowed=False)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({}, None),
        ({"drift_m": 0.0021}, "moved by 2.10 mm, 0.01 deg within 5 s in Warp"),
        ({"drift_rad": 0.05}, "moved by 0.01 mm, 2.86 deg within 5 s in Warp"),
        ({"sunk_m": 0.2}, "fell in Warp"),
        ({"penetration_m": 0.002}, "pieces 2.00 mm deep in Warp"),
        ({"overflowed": True}, "Warp needed more contacts or constraints than it had room for"),
    ],
)
def test_what_an_engine_finds_is_held_to_the_certificate_s_limits(change, problem):
    found = replace(STILL, **change)
    audit = audit_engine({"epsilon_m": 0.001}, found, "Warp")
    assert audit.problems == (() if problem is None else (problem,))
    assert audit.measured["drift_m"] == found.drift_m


def test_another_engine_takes_datasets_alone(tmp_path, run):
    out = write_learnable_dataset(tmp_path / "out", scenes=1)
    for arguments in ((tmp_path, "--engine", "warp"), (out, "--engine", "warp", "--trajectories")):
        code, _, err = run("verify", *arguments)
        assert code == 2
        assert "--engine is for the scenes of a dataset" in " ".join(err.replace("│", " ").split())


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(("engine", "package"), [("warp", "mujoco_warp"), ("newton", "newton")])
def test_scenes_rest_in_other_engines_too(tmp_path, run, engine, package):
    """Run with mujoco-warp 4.0.0, and with newton 1.8.0 and MuJoCo 3.17, on Warp's CPU backend.

    In Newton these blocks, which overlap by 0.4 µm, touch from the second step on; the first is what is counted.
    """
    pytest.importorskip(package, reason="installed where it is tested")
    out = write_learnable_dataset(tmp_path / "out", scenes=2)
    code, said, _ = run("verify", out, "--engine", engine, "--json")
    document = json.loads(said[said.index("{") :])
    assert (code, document["verified"]) == (0, 2)
    assert all(scene["drift_m"] < 1e-4 for scene in document["scenes"])
    if engine == "warp":
        assert all(scene["contacts"] >= 12 for scene in document["scenes"])
