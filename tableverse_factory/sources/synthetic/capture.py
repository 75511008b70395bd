"""Synthetic scene as a capture folder (docs/formats.md), with the ground truth."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from schemas.detection import Box, Composite, Container, Content, Detection, Detections
from schemas.geometry import IdImage, Mask, Pose
from tableverse_factory.core.png import encode_png
from tableverse_factory.physics.mjcf.obj_assets import encode_obj, scale_and_quantize
from tableverse_factory.sources.synthetic.scene import SyntheticObject, SyntheticScene

TRUTH_FORMAT = "tableverse-truth-1"
SOURCE = {"source": "synthetic", "licence": "CC0-1.0"}
MIN_VISIBLE_PIXELS = 60
MIN_VISIBLE_FRACTION = 0.01


def encode_capture(scene: SyntheticScene, origin: dict[str, Any]) -> dict[str, bytes]:
    """Encode every file of the capture, by its path within the folder."""
    ids = make_instance_ids(scene)
    camera = scene.camera
    intrinsics = {name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy", "width", "height")}
    files = {
        "color.png": encode_png(scene.color),
        "depth.png": encode_png(scene.depth),
        "masks.png": encode_png(ids.astype(np.uint16)),
        "camera.json": _encode_json({**intrinsics, "depth_scale": scene.depth_scale}),
        "detections.json": _encode_json(build_detections(scene, ids).model_dump(mode="json", exclude_none=True)),
        "source.json": _encode_json(SOURCE),
        "truth.json": _encode_json(_make_truth(scene, origin)),
    }
    for index, item in enumerate(scene.objects):
        files[_mesh_path(index)] = encode_obj(scale_and_quantize(item.placed.model.mesh, 1.0))
    return files


def write_files(files: dict[str, bytes], folder: Path) -> None:
    """Write files below an existing folder."""
    for name, data in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)


def make_instance_ids(scene: SyntheticScene) -> IdImage:
    """Make `masks.png`: object numbers from 1; 0 elsewhere and for objects seen too little to detect."""
    values = np.array([k + 1 if _is_seen(item) else 0 for k, item in enumerate(scene.objects)] + [0], dtype=np.int32)
    return values[scene.ids]


def build_detections(scene: SyntheticScene, ids: IdImage) -> Detections:
    """Build the answer of a perfect detector in the paper's schema; the table is one of the detections.

    A container with a visible content is a composite, otherwise a regular object; so are contents of hidden containers.
    """
    regular, composites = [], []
    if scene.table_pixels.any():
        regular.append(Detection(label="table", bbox_xyxy=_make_box(scene.table_pixels), description="the table"))
    seen = [index for index, item in enumerate(scene.objects) if _is_seen(item)]
    contents: dict[int, list[int]] = {index: [] for index in seen}
    for index in seen:
        holder = scene.objects[index].contained_in
        if holder in contents and scene.objects[holder].contained_in is None:
            contents[holder].append(index)
    nested = {index for inside in contents.values() for index in inside}
    for index in seen:
        if contents[index]:
            composites.append(_make_composite(scene, ids, index, contents[index]))
        elif index not in nested:
            regular.append(Detection(**_name_object(scene, index), bbox_xyxy=_make_box(ids == index + 1)))
    return Detections(detections=tuple(regular), composites=tuple(composites))


def _make_composite(scene: SyntheticScene, ids: IdImage, holder: int, inside: list[int]) -> Composite:
    container = Container(**_name_object(scene, holder), bbox=_make_box(ids == holder + 1))
    contents = tuple(Content(**_name_object(scene, k), bbox=_make_box(ids == k + 1), count=1) for k in inside)
    listed = ", ".join(content.description for content in contents)
    return Composite(description=f"{container.description} with {listed}", container=container, contents=contents)


def _name_object(scene: SyntheticScene, index: int) -> dict[str, Any]:
    model = scene.objects[index].placed.model
    return {"label": model.label, "description": model.description, "instance_id": index + 1}


def _is_seen(item: SyntheticObject) -> bool:
    return item.visible_pixels >= MIN_VISIBLE_PIXELS and item.visible_fraction >= MIN_VISIBLE_FRACTION


def _make_box(mask: Mask) -> Box:
    """Make a box (xmin, ymin, xmax, ymax) of the pixels' outer edges, over width and height, 0–1000."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    height, width = mask.shape
    edges = (columns[0] / width, rows[0] / height, (columns[-1] + 1) / width, (rows[-1] + 1) / height)
    x0, y0, x1, y1 = (round(1000.0 * float(edge), 2) for edge in edges)
    return x0, y0, x1, y1


def _make_truth(scene: SyntheticScene, origin: dict[str, Any]) -> dict[str, Any]:
    return {
        "format": TRUTH_FORMAT,
        "origin": origin,
        "frame": "table: z up, table plane z=0, origin amid the table's upper face, metres",
        "table": {"center_xy": [0.0, 0.0], "half_size_xy": list(scene.table_half_xy)},
        "camera_to_table": _pose_to_json(scene.camera_to_table),
        "objects": [_make_object_entry(index, item) for index, item in enumerate(scene.objects)],
    }


def _make_object_entry(index: int, item: SyntheticObject) -> dict[str, Any]:
    model = item.placed.model
    return {
        "instance_id": index + 1,
        "label": model.label,
        "description": model.description,
        "mesh": _mesh_path(index),
        "pose": _pose_to_json(item.placed.pose),
        "size_m": np.ptp(model.mesh.vertices, axis=0).tolist(),
        "mass_kg": model.mass_kg,
        "contained_in": None if item.contained_in is None else item.contained_in + 1,
        "visible_fraction": item.visible_fraction,
        "visible_pixels": item.visible_pixels,
    }


def _mesh_path(index: int) -> str:
    return f"truth/{index + 1}.obj"


def _pose_to_json(pose: Pose) -> dict[str, list[float]]:
    return {"position": pose.position.tolist(), "quaternion_wxyz": pose.quaternion_wxyz.tolist()}


def _encode_json(value: dict[str, Any]) -> bytes:
    return (json.dumps(value, indent=1) + "\n").encode()
