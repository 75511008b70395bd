"""Synthetic layouts: true poses, and the same with the errors of a registration.

A layout holds the scene that the capture of the same seed and number shows, so both can be measured side by side.
"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from schemas.geometry import Pose
from schemas.identity import make_object_id
from tableverse_factory.core.seeding import make_rng
from tableverse_factory.core.storage.files import write_atomic
from tableverse_factory.geometry.math.transforms import (
    multiply_quaternions,
    normalize_quaternion,
    quaternion_about_z,
    transform_points,
)
from tableverse_factory.geometry.mesh.meshes import box_center
from tableverse_factory.physics.mjcf.obj_assets import encode_obj, scale_and_quantize
from tableverse_factory.sources.synthetic.capture import SOURCE
from tableverse_factory.sources.synthetic.recipes import PlacedModel
from tableverse_factory.sources.synthetic.scene import arrange_scene, find_container
from tableverse_factory.sources.synthetic.synthesize import check_numbers, check_origin, check_output_folder

GENERATOR = "tableverse-synth-layout-1"  # Changes whenever the same seed no longer gives the same bytes
LAYOUTS, MESHES, TRUTH = "layouts", "meshes", "truth"

POSITION_NOISE_M = (0.007, 0.007, 0.0035)
"""Standard deviation of the box centre along x, y and z; the visible table makes heights more accurate."""
HEADING_NOISE = float(np.deg2rad(4.0))
TILT_NOISE = float(np.deg2rad(1.0))  # About each horizontal axis
SCALE_NOISE = 0.03


def synthesize_layouts(
    out: Path, scenes: int, seed: int, on_scene: Callable[[Path, bool], None] | None = None
) -> list[Path]:
    """Write layouts to `out/layouts/synth_000000.json` and so on, meshes to `out/meshes`, truth to `out/truth`.

    `out/layouts/source.json` states their licence.

    Layout k has the same bytes whatever the number of layouts; those that are there already, of the same seed, stay.
    """
    check_numbers(scenes, seed)
    check_output_folder(out, lambda path: path.name in (LAYOUTS, MESHES, TRUTH))
    source = out / LAYOUTS / "source.json"
    if not source.exists():
        write_atomic(source, _encode_json(SOURCE))
    paths = []
    for index in range(scenes):
        path = out / LAYOUTS / f"synth_{index:06d}.json"
        origin = {"generator": GENERATOR, "seed": seed, "scene": path.stem}
        made = not path.exists()
        if made:
            for name, data in encode_layout(path.stem, seed, origin).items():
                write_atomic(out / name, data)
        else:
            check_origin(path, path, origin, "layout")
        paths.append(path)
        if on_scene is not None:
            on_scene(path, made)
    return paths


def encode_layout(scene_id: str, seed: int, origin: dict[str, Any]) -> dict[str, bytes]:
    """Encode every file of one layout by its path, the layout last: where it exists, the others do."""
    placed, _ = arrange_scene(make_rng(seed, scene_id, "synth"), scene_id)
    rng = make_rng(seed, scene_id, "synth-registration")
    files, objects, truth = {}, [], {}
    for index, item in enumerate(placed):
        name, holder = make_object_id(index), find_container(index, placed)
        mesh = f"{MESHES}/{scene_id}_{name}.obj"
        files[mesh] = encode_obj(scale_and_quantize(item.model.mesh, 1.0))
        pose, scale = perturb_pose(item, rng)
        entry: dict[str, Any] = {"id": name, "label": item.model.label, "mesh": f"../{mesh}"}
        entry |= {"scale": scale, "pose": _pose_to_json(pose)}
        objects.append(entry if holder is None else entry | {"contained_in": make_object_id(holder)})
        truth[name] = {**_pose_to_json(item.pose), "scale": 1.0}
    layout = {"scene_id": scene_id, "frame": "table: z up, table plane z=0, metres", "origin": origin}
    files[f"{TRUTH}/{scene_id}.json"] = _encode_json(truth)
    files[f"{LAYOUTS}/{scene_id}.json"] = _encode_json({**layout, "objects": objects})
    return files


def perturb_pose(item: PlacedModel, rng: np.random.Generator) -> tuple[Pose, float]:
    """Perturb pose and scale as a registration would, about the centre of the mesh's box."""
    center = box_center(item.model.mesh)
    tilt, heading = rng.normal(0.0, TILT_NOISE, 2), float(rng.normal(0.0, HEADING_NOISE))
    turn = multiply_quaternions(quaternion_about_z(heading), np.array([1.0, tilt[0] / 2, tilt[1] / 2, 0.0]))
    quaternion = normalize_quaternion(multiply_quaternions(turn, item.pose.quaternion_wxyz))
    scale = round(float(np.exp(rng.normal(0.0, SCALE_NOISE))), 6)
    place = transform_points(item.pose, center[None])[0] + rng.normal(0.0, POSITION_NOISE_M)
    turned = Pose(np.zeros(3), quaternion)
    return Pose(place - transform_points(turned, center[None], scale)[0], quaternion), scale


def _pose_to_json(pose: Pose) -> dict[str, list[float]]:
    return {
        "position": [round(value, 9) for value in pose.position.tolist()],
        "quaternion_wxyz": [round(value, 12) for value in pose.quaternion_wxyz.tolist()],
    }


def _encode_json(value: dict[str, Any]) -> bytes:
    return (json.dumps(value, indent=1) + "\n").encode()
