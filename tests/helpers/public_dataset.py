"""A dataset as `tableverse export` leaves it: nothing in it names a machine; shards of scenes of any size."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from schemas.scene import Certificate, ExportedScene
from schemas.tables import OBJECTS, SCENES, TASKS, TIMINGS
from tableverse_factory.core.storage.files import write_atomic
from tableverse_factory.core.storage.parquet import build_table, encode_parquet
from tableverse_factory.dataset.shard_plan import Plan, write_plan
from tableverse_factory.dataset.shards import TarShard, shard_path
from tableverse_factory.run_record import FORMAT
from tests.helpers.small_dataset import SCENE_XML, TETRAHEDRON

_CERTIFICATE = Certificate(0.001, *[0.0] * 6, (), (), (), True, False)


def scene_name(shard: int, number: int) -> str:
    return f"s-{shard}-{number}"


def files_of(scene_id: str, n_bytes: int) -> tuple[tuple[str, bytes], ...]:
    """A scene that loads, with a picture of so many bytes that no compression makes smaller."""
    noise = np.random.default_rng(list(scene_id.encode())).bytes(n_bytes)
    return (
        ("assets/obj_000.obj", TETRAHEDRON),
        ("meta.json", b'{"scene_id": "%s"}' % scene_id.encode()),
        ("observation/color.jpg", noise),
        ("scene.xml", SCENE_XML),
    )


def write_public_dataset(
    out: Path, shards: int = 2, scenes: int = 2, n_bytes: int = 20_000, licence: str | None = "CC-BY-4.0"
) -> Path:
    """So many shards of so many scenes each."""
    for number in range(shards):
        write_shard(out, number, scenes, n_bytes, licence)
    placed = [(scene_name(shard, number), shard) for shard in range(shards) for number in range(scenes)]
    write_plan(
        out / "plan.parquet", Plan(tuple(n for n, _ in placed), ("capture",) * len(placed), tuple(s for _, s in placed))
    )
    record = {
        "format": FORMAT,
        "seed": 0,
        "fingerprint": "f" * 64,
        "config": {},
        "published": {"profile": "permissive"},
    }
    (out / "run.json").write_text(json.dumps(record))
    return out


def write_shard(out: Path, number: int, scenes: int, n_bytes: int, licence: str | None, start: int = 0) -> None:
    """One shard; its first scene begins at the byte `start` of a sparse tar, after nothing."""
    rows, objects = [], []
    path = shard_path(out, "mjcf", number)
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as file:
        file.seek(start)
        tar = TarShard(file)
        tar._tar.offset = start
        for scene_id in [scene_name(number, index) for index in range(scenes)]:
            offset, size = tar.add(ExportedScene(scene_id, files_of(scene_id, n_bytes), _CERTIFICATE, {}, (), ()))
            row = {"scene_id": scene_id, "kind": "capture", "status": "done", "stage": "export", "attempts": 1}
            row |= {"name": scene_id, "uri": scene_id, "licence": licence, "n_objects": 1, "usable": True}
            rows.append({**row, "shard": number, "tar_offset": offset, "tar_size": size})
            objects.append({"scene_id": scene_id, "object_id": "obj_000", "label": "mug", "mass_kg": 0.3})
        tar.close()
    ids = [row["scene_id"] for row in rows]
    tasks = [{"scene_id": name, "task_id": "task_000", "instruction": "Put it.", "accepted": True} for name in ids]
    timings = [{"scene_id": name, "stage": "export", "cpu_s": 1.0, "wall_s": 1.0} for name in ids]
    for folder, schema, table in (
        ("objects", OBJECTS, objects),
        ("tasks", TASKS, tasks),
        ("timings", TIMINGS, timings),
        ("scenes", SCENES, rows),
    ):
        write_atomic(shard_path(out, folder, number), encode_parquet(build_table(table, schema)))


def tree_of(folder: Path, besides: Sequence[str] = ()) -> dict[str, bytes]:
    """Every file below a folder by its path."""
    paths = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    found = {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}
    return {name: data for name, data in found.items() if name not in besides}
