"""A dataset of four scenes in two shards, a third shard not committed, written with the factory's own writers."""

from pathlib import Path

import pyarrow as pa

from schemas.scene import Certificate, ExportedScene
from schemas.tables import OBJECTS, SCENES, TASKS
from tableverse_factory.core.storage.files import write_atomic
from tableverse_factory.core.storage.parquet import build_table, encode_parquet
from tableverse_factory.dataset.shards import TarShard, shard_path

TETRAHEDRON = b"v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
SCENE_XML = b"""<mujoco model="small">
  <compiler meshdir="assets"/>
  <asset><mesh name="obj_000" file="obj_000.obj"/></asset>
  <worldbody>
    <body name="table"><geom type="plane" size="1 1 .1"/></body>
    <body name="obj_000" pos="0 0 .2"><freejoint/><geom type="mesh" mesh="obj_000"/></body>
  </worldbody>
</mujoco>"""
ESCAPE = "\x1b[2J\x1b]0;owned\x07"


def scene_files(scene_id: str) -> tuple[tuple[str, bytes], ...]:
    return (
        ("assets/obj_000.obj", TETRAHEDRON),
        ("meta.json", b'{"scene_id": "%s"}' % scene_id.encode()),
        ("observation/color.jpg", scene_id.encode() * 1000),
        ("scene.xml", SCENE_XML),
    )


LONG_DETAIL = "signal 11 after 12.3 s, when the mesh of obj_003 was registered for the second time with all points"


def write_small_dataset(out: Path) -> Path:
    _write_shard(out, 0, ["a-1"], [_row("b-2", "dropped", "settle", reason="not_at_rest", detail=f"drift {ESCAPE}")])
    _write_shard(out, 1, ["c-3", "c-4"], [_row("d-5", "failed", "place", error_kind="crash", detail=LONG_DETAIL)])
    _write_shard(out, 2, ["e-6"], [])
    shard_path(out, "scenes", 2).unlink()
    (out / "run.json").write_text("{}")
    return out


def _row(scene_id, status, stage, **more):
    return {"scene_id": scene_id, "kind": "capture", "status": status, "stage": stage, "attempts": 1, **more}


def _write_shard(out, number, done, lost):
    certificate = Certificate(0.001, *[0.0] * 6, (), (), (), True, False)
    rows, objects, tasks = [{**row, "shard": number} for row in lost], [], []
    path = shard_path(out, "mjcf", number)
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as file:
        tar = TarShard(file)
        for scene_id in done:
            offset, size = tar.add(ExportedScene(scene_id, scene_files(scene_id), certificate, {}, (), ()))
            place = {"shard": number, "tar_offset": offset, "tar_size": size}
            rows.append({**_row(scene_id, "done", "export"), "n_objects": 1, "usable": True, **place})
            for index, (label, mass) in enumerate((("red mug", 0.31), ("bowl", 0.52), (f"{ESCAPE}spoon", None))):
                objects.append({"scene_id": scene_id, "object_id": f"obj_{index:03d}", "label": label, "mass_kg": mass})
            tasks.append({"scene_id": scene_id, "task_id": "task_000", "instruction": "Put it.", "accepted": True})
        tar.close()
    for folder, schema, table in (("scenes", SCENES, rows), ("objects", OBJECTS, objects), ("tasks", TASKS, tasks)):
        write_atomic(shard_path(out, folder, number), encode_parquet(_table(table, schema)))


def _table(rows, schema) -> pa.Table:
    return build_table(sorted(rows, key=lambda row: row["scene_id"]), schema)
