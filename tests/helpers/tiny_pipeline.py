"""A pipeline of four tiny stages with every way to end, for the executors' tests; `name` of a row says what it does."""

import ctypes
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from schemas.manifest import SceneKind
from schemas.outcome import Done, Dropped
from schemas.scene import Certificate, ExportedScene
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.stage import Stage

MARKS = "TINY_LINE_MARKS"
_HOARD: list[np.ndarray] = []  # what a scene leaves behind in its process


def _mark(stage: str, scene_id: str) -> int:
    """Notes a call in the folder named by the environment; returns how many there were before it."""
    folder = os.environ.get(MARKS)
    if folder is None:
        return 0
    path = Path(folder) / f"{scene_id}.{stage}"
    before = path.stat().st_size if path.exists() else 0
    with path.open("ab") as file:
        file.write(b"x")
    return before


def look(row, config, rng, services):
    _mark("look", row.scene_id)
    if row.name.startswith("empty"):
        return Dropped("nothing_there", f"looked at {row.name}")
    return Done({"scene_id": row.scene_id, "name": row.name, "pixels": rng.integers(0, 255, 2000, dtype=np.uint8)})


def cut(item, config, rng, services):
    before = _mark("cut", item["scene_id"])
    name = item["name"]
    if name == "segfault" or before < {"segfault_once": 1, "segfault_twice": 2}.get(name, 0):
        ctypes.string_at(0)
    if name == "chatter":
        sys.stderr.write("native chatter\n" * 20_000)
        sys.stderr.flush()
        ctypes.string_at(0)
    if name == "hang" or (name == "hang_once" and before == 0):
        time.sleep(3600)
    if name == "hog":
        hold = [np.ones(8_000_000) for _ in range(1000)]
        return Done({"n": len(hold)})
    if name == "hoard":
        _HOARD.append(np.ones(37_500_000))
    if name == "large":
        hold = [np.ones(81_250_000)]
        time.sleep(0.5)
    if name.startswith("leave"):
        left = subprocess.Popen(["sleep", "60"])
        Path(os.environ[MARKS], "left").write_text(str(left.pid))
    if name in ("exit", "leave_and_exit"):
        os._exit(3)
    if name == "raise":
        raise KeyError(f"no such thing at {hex(id(item))}\nsecond line {__file__}")
    if name == "sad":
        raise GeometryError("3 vertices cannot close a surface; give at least 4")
    if name == "wrong":
        return "not an outcome"
    if name.startswith("slow"):
        time.sleep(float(name.split("_")[1]))
    if name.startswith("burn"):
        until = time.process_time() + float(name.split("_")[1])
        while time.process_time() < until:
            pass
    return Done({**item, "pieces": (item["pixels"] * 2.5, rng.normal(size=50))})


def drop_some(item, config, rng, services):
    _mark("settle", item["scene_id"])
    if item["name"].startswith("fell"):
        return Dropped("not_at_rest", "drift 0.5 m")
    return Done({**item, "drift": float(np.linalg.norm(item["pieces"][1] @ np.ones((50, 50))))})


def pack(item, config, rng, services):
    scene_id = item["scene_id"]
    _mark("pack", scene_id)
    files = (
        ("assets/pieces.bin", item["pieces"][0].tobytes()),
        ("scene.xml", f"<mujoco model='{scene_id}'/>".encode()),
    )
    if item["name"] == "bulky":
        files = (("assets/bulk.bin", bytes(40_000_000)), files[1])
    if item["name"] == "escape":
        files = (("../../evil", b"x"),)
    row = {"n_objects": 2, "usable": True, "drift_m": item["drift"], "perception": "tiny"}
    if item["name"] == "odd_row":
        row = {"no_such_column": 1}
    objects = tuple({"scene_id": scene_id, "object_id": f"obj_{i:03d}", "mass_kg": rng.random()} for i in range(2))
    tasks = ({"scene_id": scene_id, "task_id": "task_000", "accepted": True},)
    certificate = Certificate(0.001, 0.0, 0.0, 0.0, 0.0, item["drift"], 0.0, (), (), (), True, False)
    return Done(ExportedScene(scene_id, files, certificate, row, objects, tasks))


_STAGES = (
    Stage("look", "perception", look, reads=("observe",)),
    Stage("cut", "geometry", cut, reads=("rectify",)),
    Stage("fall", "physics", drop_some, reads=("settle",)),
    Stage("pack", "curation", pack, reads=("export",)),
)
PIPELINES = {SceneKind.CAPTURE: _STAGES, SceneKind.IMAGE: _STAGES, SceneKind.LAYOUT: (_STAGES[0], *_STAGES[1:])}
