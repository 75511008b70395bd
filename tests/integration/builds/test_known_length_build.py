"""A bare picture whose depth is 0.7 of the truth becomes a scene of true size, and says where its metres come from."""

import json

import numpy as np
import pytest
from PIL import Image

from tableverse_factory.dataset.dataset import open_dataset
from tests.helpers.tabletop_views import Box, look

THINGS = (Box(-0.12, 0.05, (0.1, 0.06, 0.15)), Box(0.15, -0.05, (0.08, 0.08, 0.08)))


def write_pictures(folder):
    """The same table three times: without, with and with an absurd known length; 3,000 pixels wide in the file."""
    view = look(THINGS, noise_m=0.0005)[0]
    camera = {name: getattr(view.camera, name) for name in ("fx", "fy", "cx", "cy", "width", "height")}
    for number, (name, known_m) in enumerate((("plain", None), ("measured", 0.6), ("absurd", 4.9))):
        at = folder / name
        at.mkdir(parents=True)
        picture = Image.fromarray(view.color).resize((3000, 2250), Image.Resampling.NEAREST)
        picture.paste((80 * number, 0, 0), (0, 0, 16, 16))
        picture.save(at / "table.jpg", quality=95)
        np.save(at / "table.depth.npy", (0.7 * view.depth).astype(np.float32))
        (at / "table.camera.json").write_text(json.dumps(camera))
        known = {} if known_m is None else {"known_length": {"kind": "camera_height", "length_m": known_m}}
        (at / "source.json").write_text(json.dumps({"licence": "CC0-1.0", **known}))
    return folder


@pytest.mark.slow
def test_the_tables_say_what_metres_come_from(tmp_path, run):
    write_pictures(tmp_path / "in")
    assert run("manifest", tmp_path / "in", "--out", tmp_path / "m.parquet")[0] == 0
    out = tmp_path / "out"
    line = ("build", tmp_path / "m.parquet", out, "--executor", "local", "--set", "observe.depth=recorded")
    assert run(*line)[0] == 0
    dataset = open_dataset(out)
    rows = {row["uri"].split("/")[-2]: row for row in dataset.scenes.to_table().to_pylist()}
    assert rows["absurd"]["reason"] == "scale_implausible"
    assert rows["absurd"]["scale_source"] is None
    told = {name: [rows[name][key] for key in ("scale_source", "scale_sigma", "intrinsics_source")] for name in rows}
    assert told["plain"] == ["estimated", None, "capture"]
    assert told["measured"] == ["measured", pytest.approx(0.0225, abs=0.001), "capture"]
    assert json.loads(rows["measured"]["known_length"]) == {"kind": "camera_height", "length_m": 0.6}
    meta = {name: dataset.scene(rows[name]["scene_id"]).meta for name in ("plain", "measured")}
    assert meta["measured"]["metric"]["scale_source"] == "measured"
    heights = {name: meta[name]["camera_to_table"]["position"][2] for name in meta}
    assert heights["measured"] == pytest.approx(0.6, rel=0.01)
    assert heights["plain"] == pytest.approx(0.42, rel=0.01)
    objects = dataset.objects.to_table().to_pylist()
    tops = sorted(row["size_z_m"] for row in objects if row["scene_id"] == rows["measured"]["scene_id"])
    assert tops == pytest.approx([0.08, 0.15], rel=0.03)
    assert run("verify", out)[0] == 0
