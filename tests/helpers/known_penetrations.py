"""Two boxes planted at known depths, in every format that methods come in, written without the code under test."""

import json
from pathlib import Path

import numpy as np
import trimesh

SIDE = 0.08
DEPTHS_MM = {"clean": -1.0, "half": 0.5, "two": 2.0, "ten": 10.0}
INNER = 0.03
"""Side of the box that lies inside the other in the scene `inside`; that is also how deep it is."""

ORDER = ("clean", "half", "two", "ten", "inside")


def boxes(name: str) -> list[tuple[str, float, np.ndarray]]:
    """Name, side [m] and centre [m] of each box, z up."""
    big = ("big", SIDE, np.array([0.02, 0.05, SIDE / 2]))
    if name == "inside":
        return [big, ("small", INNER, big[2] + [0.01, 0.0, 0.005])]
    reach = SIDE - DEPTHS_MM[name] * 1e-3
    return [big, ("small", SIDE, big[2] + [0.0, 0.0, reach])]


def write_layouts(folder: Path) -> Path:
    (folder / "meshes").mkdir(parents=True)
    (folder / "layouts").mkdir()
    (folder / "meshes" / "unit.obj").write_text(trimesh.creation.box((1, 1, 1)).export(file_type="obj"))
    for scene in ORDER:
        objects = [
            {
                "id": name,
                "mesh": "../meshes/unit.obj",
                "scale": side,
                "pose": {"position": center.tolist(), "quaternion_wxyz": [1, 0, 0, 0]},
            }
            for name, side, center in boxes(scene)
        ]
        (folder / "layouts" / f"{scene}.json").write_text(json.dumps({"objects": objects}))
    return folder / "layouts"


def write_glbs(folder: Path) -> Path:
    """A file per scene, Y-up, the table among the nodes."""
    folder.mkdir(parents=True)
    for name in ORDER:
        glb_scene(name).export(folder / f"{name}.glb")
    return folder


def glb_scene(name: str) -> trimesh.Scene:
    scene = trimesh.Scene()
    for part, side, center in boxes(name):
        y_up = np.eye(4)
        y_up[:3, 3] = [center[0], center[2], -center[1]]
        scene.add_geometry(trimesh.creation.box((side, side, side)), node_name=part, geom_name=part, transform=y_up)
    table = trimesh.creation.box((1.0, 0.04, 1.0))  # the big box sinks into it: a table does not count
    scene.add_geometry(table, node_name="Table", geom_name="Table")
    return scene


def write_released(folder: Path) -> Path:
    """A folder per scene with assets, scene.glb and XML, as the authors of the paper release theirs."""
    for name in ORDER:
        home = folder / name
        (home / "assets").mkdir(parents=True)
        (home / "assets" / "unit.obj").write_text(trimesh.creation.box((1, 1, 1)).export(file_type="obj"))
        (home / "scene.glb").write_bytes(b"never read where there is an XML")
        bodies = "".join(
            f'<body name="{part}" pos="{c[0]:.9f} {c[1]:.9f} {c[2]:.9f}"><freejoint/>'
            f'<geom type="mesh" mesh="{part}" contype="0" conaffinity="0"/><geom type="mesh" mesh="{part}"/></body>'
            for part, _, c in boxes(name)
        )
        meshes = "".join(
            f'<mesh name="{part}" file="unit.obj" scale="{side} {side} {side}"/>' for part, side, _ in boxes(name)
        )
        (home / f"{name}.xml").write_text(
            f'<mujoco><compiler meshdir="assets"/><asset>{meshes}</asset><worldbody>'
            f'<geom name="table" type="plane" size="1 1 1"/>{bodies}</worldbody></mujoco>'
        )
    return folder


WRITERS = {"layout": write_layouts, "glb": write_glbs, "mjcf": write_released}
