"""Bad meshes through a whole build: a repaired object or a row with a reason each, and the neighbours unharmed."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from schemas.config import Config, RectifyConfig, RunConfig
from schemas.geometry import TriangleMesh
from tableverse_factory.dataset.dataset import open_dataset
from tableverse_factory.sources.manifest import make_manifest, write_manifest
from tests.helpers.bad_meshes import BAD_MESHES, BOX, LARGE_MESHES
from tests.helpers.builds import Silent, scenes
from workers.run import BuildRequest, run_build

SOME = ("open", "nan", "single_triangle", "three_micrometres", "forty_metres", "klein_bottle", "no_faces", "inside_out")


def bumpy_ball(n: int = 60) -> TriangleMesh:
    """A ball with 162 bumps and hollows: CoACD searches for minutes."""
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, 2 * n, endpoint=False), np.linspace(0, np.pi, n + 1)[1:-1])
    r = 0.04 * (1 + 0.2 * np.sin(9 * u) * np.sin(9 * v))
    rings = np.stack([r * np.sin(v) * np.cos(u), r * np.sin(v) * np.sin(u), r * np.cos(v)], axis=-1).reshape(-1, 3)
    index = np.arange(len(rings)).reshape(u.shape)
    after = np.roll(index, -1, axis=1)
    a, b, c, d = index[:-1], after[:-1], after[1:], index[1:]
    north, south = np.full(2 * n, len(rings)), np.full(2 * n, len(rings) + 1)
    faces = [np.stack([a, d, c], -1).reshape(-1, 3), np.stack([a, c, b], -1).reshape(-1, 3)]
    faces += [np.stack([north, index[0], after[0]], -1), np.stack([south, after[-1], index[-1]], -1)]
    vertices = np.concatenate([rings, [[0, 0, 0.04], [0, 0, -0.04]]])
    return TriangleMesh(vertices, np.concatenate(faces).astype(np.int32))


def write_layouts(folder: Path, meshes: dict[str, TriangleMesh], suffix: str = "obj") -> Path:
    """A layout for each mesh, beside a box that is fine; and the manifest."""
    (folder / "layouts").mkdir(parents=True)
    (folder / "meshes").mkdir()
    for name, mesh in {**meshes, "box": BOX}.items():
        (folder / "meshes" / f"{name}.{suffix}").write_bytes(_file(mesh, suffix))
    for name, mesh in meshes.items():
        low = float(np.nan_to_num(mesh.vertices[:, 2]).min())
        bad = _object("bad", f"{name}.{suffix}", 0.0, 0.001 - low if abs(low) < 100 else 0.0)
        good = _object("good", f"box.{suffix}", 0.6, 0.031)
        (folder / "layouts" / f"{name}.json").write_text(json.dumps({"objects": [bad, good]}))
    path = folder / "manifest.parquet"
    write_manifest(path, make_manifest([str(folder / "layouts")], Config().observe).rows)
    return path


def _file(mesh: TriangleMesh, suffix: str) -> bytes:
    if suffix == "ply":
        return bytes(trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(file_type="ply"))
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in mesh.vertices.tolist()]
    lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in mesh.faces.tolist()]
    return "\n".join(lines).encode()


def _object(name: str, mesh: str, x: float, z: float) -> dict[str, Any]:
    pose = {"position": [x, 0.0, z], "quaternion_wxyz": [1, 0, 0, 0]}
    return {"id": name, "label": "thing", "mesh": f"../meshes/{mesh}", "pose": pose}


def build(manifest: Path, config: Config) -> dict[str, dict[str, Any]]:
    """Rows of scenes/ by the name of the layout; of the done, `repaired` says how the bad object came through."""
    out = manifest.parent / "out"
    run_build(BuildRequest(manifest, out, config, manifest.parent / "cache"), Silent())
    rows = {Path(row["uri"]).stem: row for row in scenes(out)}
    for row in open_dataset(str(out)).objects.to_table().to_pylist():
        if row["object_id"] == "bad":
            next(r for r in rows.values() if r["scene_id"] == row["scene_id"])["repaired"] = row["mesh_repaired"]
    return rows


def check(rows: dict[str, dict[str, Any]], name: str) -> None:
    row = rows[name]
    if "refused" in BAD_MESHES[name].ends:
        left_out = row["status"] == "done" and row["n_objects"] == 1
        assert left_out or (row["status"] == "dropped" and row["reason"] == "bad_mesh" and row["detail"])
    else:
        assert (row["status"], row["n_objects"]) == ("done", 2), row["detail"]
        assert row["repaired"] in BAD_MESHES[name].ends


@pytest.mark.slow  # tests/geometry/mesh has the meshes, test_real_line.py a build with one
def test_some_bad_meshes_through_a_build(tmp_path: Path) -> None:
    rows = build(write_layouts(tmp_path, {name: BAD_MESHES[name].make() for name in SOME}), Config())
    for name in SOME:
        check(rows, name)


@pytest.mark.slow
def test_all_bad_meshes_through_a_build(tmp_path: Path) -> None:
    rows = build(write_layouts(tmp_path, {name: bad.make() for name, bad in BAD_MESHES.items()}), Config())
    for name in BAD_MESHES:
        check(rows, name)


@pytest.mark.slow
def test_two_million_faces_through_a_build(tmp_path: Path) -> None:
    rows = build(write_layouts(tmp_path, {name: bad.make() for name, bad in LARGE_MESHES.items()}, "ply"), Config())
    assert {name: row["status"] for name, row in rows.items()} == dict.fromkeys(LARGE_MESHES, "done")


@pytest.mark.slow
def test_a_search_of_coacd_without_end_costs_its_scene_alone(tmp_path: Path) -> None:
    """Native code that does not come back is killed with its process; the scene after it runs in another."""
    manifest = write_layouts(tmp_path, {"a_bumpy": bumpy_ball(), "b_open": BAD_MESHES["open"].make()})
    config = Config(
        run=RunConfig(deadline_s=25.0, attempts=1), rectify=RectifyConfig(decomposition="coacd", max_pieces=256)
    )
    rows = build(manifest, config)
    failed = rows["a_bumpy"]
    assert (failed["status"], failed["stage"], failed["error_kind"]) == ("failed", "rectify", "timeout")
    assert rows["b_open"]["status"] == "done"
