"""`bench decompose` on solids whose pieces are known on paper."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from typer.testing import CliRunner

from tableverse_factory.cli.main import app
from tableverse_factory.evaluation.bench.decompose import bench_decompose, summarize_pieces
from tableverse_factory.evaluation.bench.measurement import read_meshes
from tableverse_factory.geometry.mesh.meshes import from_trimesh
from tableverse_factory.physics.mjcf.obj_assets import encode_obj


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A box, and a bowl of 16 cm."""
    line = [(0, 0), (0.04, 0), (0.08, 0.06), (0.074, 0.06), (0.036, 0.006), (0, 0.006)]
    bowl = trimesh.creation.revolve(np.array(line), sections=32)
    for name, mesh in (("bowl", bowl), ("box", trimesh.creation.box((0.2, 0.1, 0.05)))):
        (tmp_path / f"{name}.obj").write_bytes(encode_obj(from_trimesh(mesh)))
    return tmp_path


@pytest.mark.heavy
def test_a_box_is_one_piece_of_its_own_volume_and_a_bowl_stays_open(folder: Path) -> None:
    bowl, box = bench_decompose(read_meshes(folder), ["cut"])
    assert (bowl.mesh, box.mesh) == ("bowl.obj", "box.obj")
    assert box.pieces == 1
    assert box.volume_ratio == pytest.approx(1.0, abs=1e-6)
    assert box.hausdorff == pytest.approx(0.0, abs=1e-6)
    assert bowl.pieces > 1
    assert bowl.cavity_kept > 0.5
    assert bowl.volume_error == pytest.approx(abs(bowl.volume_ratio - 1.0))
    overall = summarize_pieces([bowl, box], ["cut"])[0]
    assert overall.pieces == bowl.pieces + 1
    assert overall.cpu_s == pytest.approx(bowl.cpu_s + box.cpu_s)
    assert overall.volume_error == pytest.approx((bowl.volume_error + box.volume_error) / 2)
    assert overall.faster == 1.0


def test_the_command_compares_with_the_first_method(folder: Path) -> None:
    (folder / "bowl.obj").rename(folder / "second.obj")
    arguments = ["bench", "decompose", str(folder), "--most", "1", "--methods", "coacd, cut"]
    answer = json.loads(CliRunner().invoke(app, [*arguments, "--json"]).stdout)
    first, second = answer["meshes"]
    assert (first["mesh"], first["method"], second["method"]) == ("box.obj", "coacd", "cut")
    assert first["faster"] == 1.0
    assert second["faster"] == pytest.approx(first["cpu_s"] / second["cpu_s"])
    assert [row["method"] for row in answer["together"]] == ["coacd", "cut"]


def test_bad_meshes_are_named_together(tmp_path, run):
    for name in "abcdefg":
        (tmp_path / f"{name}.stl").write_bytes(b"solid")
    (tmp_path / "box.stl").write_bytes(trimesh.creation.box().export(file_type="stl"))
    code, out, err = run("bench", "decompose", tmp_path)
    assert (code, out) == (1, "")
    assert [name for name in "abcdefg" if f"{name}.stl" in err] == list("abcde")
    assert "and 2 more" in err


def test_wrong_methods_are_named_before_a_mesh_is_read(tmp_path, run):
    (tmp_path / "a.stl").write_bytes(b"solid")
    assert "unknown method 'magic'" in run("bench", "decompose", tmp_path, "--methods", "cut,magic")[2]
    assert "method 'cut' is named twice" in run("bench", "decompose", tmp_path, "--methods", "cut, cut")[2]


@pytest.mark.heavy
def test_coacd_and_open3d_load_in_one_process():
    code = (
        "from tableverse_factory.geometry.convex.coacd import load_coacd; load_coacd();"
        "import tableverse_factory.evaluation.bench.decompose, tableverse_factory.geometry.mesh.height_maps"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)
