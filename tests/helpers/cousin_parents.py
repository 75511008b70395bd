"""A small dataset of painted boxes and cans, built by the real stages, whose scenes have cousins."""

import json
from pathlib import Path

import numpy as np
import trimesh

from schemas.config import Config, RunConfig
from tableverse_factory.sources.manifest import create_manifest
from tests.helpers.builds import Silent
from workers.run import BuildRequest, run_build

SHAPES = {
    "cereal box": trimesh.creation.box((0.06, 0.05, 0.12)),
    "tea box": trimesh.creation.box((0.07, 0.06, 0.10)),
    "book": trimesh.creation.box((0.16, 0.12, 0.03)),
    "soda can": trimesh.creation.cylinder(0.033, 0.11, sections=24),
    "apple": trimesh.creation.icosphere(2, 0.035),
}
SCENES = {  # names with labels, places and headings; the book carries the tea box
    "breakfast": (
        ("book", 0.0, 0.0, 0.015, 0.2),
        ("tea box", 0.0, 0.0, 0.08, 0.5),
        ("soda can", 0.2, 0.05, 0.055, 0.0),
    ),
    "snack": (
        ("cereal box", -0.1, 0.0, 0.06, 0.3),
        ("apple", 0.05, 0.1, 0.035, 0.0),
        ("tea box", 0.1, -0.1, 0.05, 1.0),
    ),
    "desk": (("book", 0.0, 0.05, 0.015, 1.2), ("soda can", 0.2, 0.0, 0.055, 0.0), ("cereal box", -0.2, 0.0, 0.06, 0.7)),
}


def write_layouts(folder: Path) -> Path:
    """Layout files of the scenes, with a licence."""
    (folder / "meshes").mkdir(parents=True)
    colors = np.random.default_rng(0).integers(40, 220, (len(SHAPES), 3))
    for (name, shape), color in zip(SHAPES.items(), colors, strict=True):
        rgb = " ".join(f"{value / 255:.4f}" for value in color)
        lines = [f"v {x:.5f} {y:.5f} {z:.5f} {rgb}" for x, y, z in shape.vertices]
        lines += [f"f {a} {b} {c}" for a, b, c in shape.faces + 1]
        (folder / "meshes" / f"{name.replace(' ', '_')}.obj").write_text("\n".join(lines) + "\n")
    for name, things in SCENES.items():
        objects = [
            {
                "id": f"obj_{index:03d}",
                "label": label,
                "mesh": f"meshes/{label.replace(' ', '_')}.obj",
                "pose": {
                    "position": [x, y, z],
                    "quaternion_wxyz": [float(np.cos(heading / 2)), 0.0, 0.0, float(np.sin(heading / 2))],
                },
            }
            for index, (label, x, y, z, heading) in enumerate(things)
        ]
        (folder / f"{name}.json").write_text(json.dumps({"objects": objects}))
    (folder / "source.json").write_text('{"source": "made by hand", "licence": "CC0-1.0"}')
    return folder


def make_request(manifest: Path, out: Path, **changes: object) -> BuildRequest:
    """A build of the real stages in this process."""
    config = Config(run=RunConfig(shard_size=4))
    return BuildRequest(manifest, out, config, cache_dir=out.parent / "cache", **changes)


def build_parents(folder: Path) -> Path:
    """The finished dataset of the layouts."""
    create_manifest([str(write_layouts(folder / "layouts"))], str(folder / "layouts.parquet"))
    run_build(make_request(folder / "layouts.parquet", folder / "out"), Silent())
    return folder / "out"
