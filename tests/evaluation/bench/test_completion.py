import json

import numpy as np
import pytest
import trimesh

from schemas.geometry import TriangleMesh
from tableverse_factory.cli.bench_perception import _show_completions, _show_way
from tableverse_factory.evaluation.bench.completion import (
    HOLLOW_SHARE,
    CompletionScore,
    build_height_field,
    measure_cavity,
    score_completion,
)
from tableverse_factory.evaluation.bench.placement import PlacementError
from tableverse_factory.geometry.mesh.meshes import from_trimesh, to_trimesh


def cup(wall: float = 0.004) -> TriangleMesh:
    outline = [(0, 0), (0.04, 0), (0.04, 0.08), (0.04 - wall, 0.08), (0.04 - wall, wall), (0, wall)]
    return from_trimesh(trimesh.creation.revolve(np.array(outline), sections=48))


@pytest.mark.heavy
def test_a_cup_is_hollow_and_a_ring_or_an_upturned_cup_is_not():
    upturned = TriangleMesh(cup().vertices * [1.0, 1.0, -1.0] + [0.0, 0.0, 0.08], cup().faces[:, ::-1])
    ring = from_trimesh(trimesh.creation.annulus(0.036, 0.04, 0.03))
    assert measure_cavity(cup())[0] > 0.5
    assert measure_cavity(upturned)[0] < HOLLOW_SHARE
    assert measure_cavity(ring)[0] < HOLLOW_SHARE


def test_overlap_of_boxes_is_the_analytic_one():
    box = trimesh.creation.box((0.1, 0.06, 0.04))
    moved = box.copy()
    moved.apply_translation((0.02, 0.0, 0.0))
    found = score_completion("box", 0, "moved", from_trimesh(box), from_trimesh(moved))
    assert abs(found.iou - 0.08 / 0.12) < 0.02


def test_a_height_field_fills_all_below_the_points():
    x, y = np.meshgrid(np.linspace(0.0, 0.1, 101), np.linspace(0.0, 0.06, 61))
    field = to_trimesh(build_height_field(np.stack([x, y, np.full_like(x, 0.05)], axis=-1).reshape(-1, 3)))
    assert field.is_watertight
    assert abs(field.volume / (0.1 * 0.06 * 0.05) - 1.0) < 0.08


@pytest.mark.parametrize("bench", ["completion", "decompose"])
def test_a_folder_without_meshes_is_one_line_and_no_table(tmp_path, run, bench):
    code, out, err = run("bench", bench, tmp_path)
    assert (code, out) == (1, "")
    assert "holds no meshes: give a folder of .obj, .ply, .stl, .glb files\n" in err


@pytest.mark.parametrize("bench", ["completion", "decompose"])
@pytest.mark.parametrize(
    ("size", "why"),
    [((60.0, 50.0, 40.0), "60 x 50 x 40 m: give a solid in metres, 0.005 to 1 m along"), ((0.06, 0.05, 0.0), "flat")],
    ids=["millimetres", "flat"],
)
def test_what_is_no_solid_in_metres_is_one_line(tmp_path, run, bench, size, why):
    box = trimesh.creation.box()
    box.vertices *= size
    (tmp_path / "BOX.OBJ").write_text(box.export(file_type="obj"))
    (tmp_path / "torn.stl").write_bytes(b"solid")
    (tmp_path / "folder.obj").mkdir()
    (tmp_path / "gone.obj").symlink_to(tmp_path / "nowhere")
    code, out, err = run("bench", bench, tmp_path)
    assert (code, out) == (1, "")
    assert f"BOX.OBJ is {why}" in err
    assert "torn.stl" in err
    assert "folder.obj" not in err


@pytest.mark.slow  # figures of a bench
@pytest.mark.heavy
def test_views_are_those_that_were_asked_for(tmp_path, run):
    (tmp_path / "box.obj").write_text(trimesh.creation.box((0.06, 0.05, 0.04)).export(file_type="obj"))
    found = {}
    for view in ("20,35", "200,60"):
        code, out, _ = run("bench", "completion", tmp_path, "--view", view, "--seed", 4, "--error-mm", 1, "--json")
        said = json.loads(out)
        found[view] = {row["method"]: row["iou"] for row in said["scores"]}
        assert code == 0
        assert {row["view"] for row in said["scores"]} == {0}
        assert (said["seed"], said["error_mm"]) == (4, 1.0)
        assert said["views"] == [[float(part) for part in view.split(",")]]
    assert found["20,35"]["hull"] != found["200,60"]["hull"]


@pytest.mark.parametrize("view", ["north", "20", "20,95", "nan,40"])
def test_a_view_that_is_none_is_refused_with_what_would_be_right(tmp_path, run, view):
    code, _, err = run("bench", "completion", tmp_path, "--view", view)
    assert code == 2
    assert "200,25" in " ".join(err.split())


@pytest.mark.heavy
def test_figures_come_as_strict_json_too(tmp_path, run):
    (tmp_path / "NaN.obj").write_text(trimesh.creation.box((0.06, 0.05, 0.04)).export(file_type="obj"))
    code, out, _ = run("bench", "completion", tmp_path, "--json")
    rows = json.loads(out, parse_constant=pytest.fail)["scores"]
    assert code == 0
    assert {row["method"] for row in rows} > {"hull", "height field"}
    assert {(row["mesh"], row["cavity_kept"]) for row in rows} == {("NaN.obj", None)}


def test_no_name_of_a_table_is_cut_in_a_narrow_place(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "30")
    _show_completions([CompletionScore("a", 0, "carved/revolution", 0.5, 0.001, 0.01, True, 0.9, 1.5)])
    figures = (0.1234, 0.002, 1.5, 0.1, 0.001, 0.05, 0.1, 0.1)
    _show_way(
        "masks by geometric, meshes carved", [PlacementError("table", "a", "carved/revolution", 0.5, 1, *figures)]
    )
    said = capsys.readouterr().out
    assert "…" not in said
    for names in ("method views IoU median mm hollow cavity", "completion n mm ° turned size % fit mm mm/std °/std"):
        assert names in " ".join(said.split())
    assert max(map(len, said.splitlines())) < 120
