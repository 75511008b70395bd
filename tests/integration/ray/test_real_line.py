"""The real stages on sound and hostile input: each entry ends as it should, and Ray gives the bytes of one process."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from schemas.config import Config, ObserveConfig
from tableverse_factory.sources.manifest import make_manifest, write_manifest
from tableverse_factory.sources.synthetic.synthesize import synthesize_captures
from tests.helpers.builds import Silent, digests, scenes
from tests.helpers.captures_on_disk import huge_png, write_capture, write_layout
from workers.run import BuildRequest, run_build

NAN_MESH = b"v nan 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


@pytest.fixture(scope="module")
def manifest(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("real")
    synthesize_captures(folder / "in", 1, seed=38)  # of five things
    hostile = folder / "in" / "hostile"
    truncated = write_capture(hostile / "truncated", 1) / "color.png"
    truncated.write_bytes(truncated.read_bytes()[:200])
    write_capture(hostile / "eight_bit", 2, depth=np.full((24, 32), 80, np.uint8))
    write_capture(hostile / "nan_camera", 3, fx=float("nan"))
    write_capture(hostile / "other_size", 4, depth=np.full((12, 16), 800, np.uint16))
    (write_capture(hostile / "huge", 5) / "color.png").write_bytes(huge_png(60_000, 60_000))
    write_capture(hostile / "no_depth", 6, depth=np.zeros((24, 32), np.uint16))
    bare = hostile / "bare_table"
    _bare_table(bare)
    write_layout(hostile / "nan" / "nan_mesh.json", content=NAN_MESH)
    write_layout(hostile / "label" / "label.json", label='"/><x a="')
    write_layout(hostile / "id" / "id.json", id="../../x")
    path = folder / "images.parquet"
    write_manifest(path, make_manifest([str(folder / "in")], ObserveConfig()).rows)
    return path


@pytest.fixture(scope="module")
def local(manifest) -> Path:
    out = manifest.parent / "local"
    run_build(BuildRequest(manifest, out, Config(), manifest.parent / "cache"), Silent())
    return out


def test_every_entry_ends_with_its_true_reason(local):
    ends = {Path(row["uri"]).name: row["reason"] or row["status"] for row in scenes(local)}
    assert {name: why for name, why in ends.items() if not name.startswith("synth")} == {
        "truncated": "unreadable_color",
        "eight_bit": "depth_not_16_bit",
        "nan_camera": "bad_intrinsics",
        "other_size": "depth_size_differs",
        "huge": "picture_too_large",
        "no_depth": "depth_all_zero",
        "bare_table": "no_objects",
        "nan_mesh.json": "bad_mesh",
        "label.json": "done",
        "id.json": "bad_layout",
    }
    assert sum(row["status"] == "done" for row in scenes(local)) == 2
    assert all(row["detail"] for row in scenes(local) if row["status"] != "done")


@pytest.mark.slow
def test_ray_gives_the_same_bytes_with_a_cold_cache(manifest, local):
    out = manifest.parent / "ray"
    run_build(BuildRequest(manifest, out, Config(), manifest.parent / "cold", executor="ray", workers=2), Silent())
    assert digests(out) == digests(local)


def _bare_table(folder: Path) -> None:
    """A table seen from above at 45 degrees, and nothing on it."""
    height, width, focal = 120, 160, 150.0
    slope = (np.arange(height)[:, None] - height / 2) / focal
    depth = 1.0 / (1.0 + slope) * np.ones((1, width))
    write_capture(folder, 7, depth=np.round(1000 * depth).astype(np.uint16), **_camera(focal, width, height))
    Image.fromarray(np.full((height, width, 3), 140, np.uint8)).save(folder / "color.png")


def _camera(focal: float, width: int, height: int) -> dict[str, float]:
    return {"fx": focal, "fy": focal, "cx": width / 2, "cy": height / 2, "width": width, "height": height}
