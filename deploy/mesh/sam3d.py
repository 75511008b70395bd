"""SAM 3D Objects behind the mesh protocol. Runs in that model's own environment: see docs/mesh-process.md.

python sam3d.py --checkout sam-3d-objects --config sam-3d-objects/checkpoints/hf/pipeline.yaml
"""

import argparse
import io
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from protocol import MakeMeshes, MeshFile, MeshOrder, ModelInfo, hash_names, load_box, serve

LICENCE = "SAM License"


def main() -> None:
    """Parse the command line and serve."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--checkout", type=Path, default=Path("sam-3d-objects"), help="clone of facebookresearch's")
    parser.add_argument("--config", type=Path, help="pipeline.yaml; default: checkpoints/hf/ of the checkout")
    parser.add_argument("--version", default="1", help="of code and weights; another one asks everything again")
    parser.add_argument("--compile", action="store_true", help="compile the model: slower start, faster meshes")
    parser.add_argument("--no-depth", action="store_true", help="let the model guess the depth that is known")
    parser.add_argument("--self-test", action="store_true", help="answer with boxes, load nothing")
    options = parser.parse_args()
    if options.self_test:
        serve(ModelInfo("self-test", "1", "CC0-1.0"), load_box)
        return
    wants = ("seed",) if options.no_depth else ("seed", "depth")
    config = options.config or options.checkout / "checkpoints" / "hf" / "pipeline.yaml"
    version = f"{options.version} of {hash_names(options.checkout, config)}"
    info = ModelInfo("sam-3d-objects", version, LICENCE, wants)
    serve(info, lambda: load(options.checkout, config, options.compile), release=release)


def load(checkout: Path, config: Path, compiled: bool) -> MakeMeshes:
    """Load the model on the GPU."""
    sys.path.insert(0, str(checkout / "notebook"))
    from inference import Inference

    # Calling it fits pose and size to the picture, which is not used: its pipeline can leave it.
    pipeline = Inference(str(config), compile=compiled)._pipeline
    # It takes one picture at a time.
    return lambda orders, _: [make_one(pipeline, order) for order in orders]


def make_one(pipeline: Any, order: MeshOrder) -> MeshFile:
    """Make the mesh of one object, a GLB with y up.

    Pose and scale are ignored: they belong to the gaussians, which are z up, and the scale is not metric.
    """
    import numpy as np
    import torch
    from PIL import Image

    image = np.array(Image.open(io.BytesIO(order.picture)).convert("RGB"))
    mask = np.where(np.array(Image.open(io.BytesIO(order.mask))) > 0, 255, 0).astype(np.uint8)
    points = None if order.depth is None else torch.from_numpy(build_pointmap(order, mask.shape))
    mesh = pipeline.run(
        np.dstack([image, mask]),
        None,
        order.seed,
        with_mesh_postprocess=False,
        with_texture_baking=False,
        with_layout_postprocess=False,
        use_vertex_color=True,
        pointmap=points,
    )["glb"]
    if mesh is None:
        raise ValueError("the model decoded no mesh")
    return MeshFile(mesh.export(file_type="glb"), "glb", "y")


def build_pointmap(order: MeshOrder, shape: Sequence[int]) -> Any:
    """Compute pixel points in PyTorch3D's camera axes: x left, y up, z forward; NaN where unknown [m]. Shape (h, w, 3).

    The protocol's camera has OpenCV's axes (x right, y down, z forward).
    """
    import numpy as np

    camera = order.camera
    z = np.frombuffer(order.depth or b"", dtype="<f4").reshape(shape)
    z = np.where(z > 0.0, z, np.nan)
    rows, columns = np.indices(shape, dtype=np.float32)
    x, y = (columns - camera["cx"]) / camera["fx"] * z, (rows - camera["cy"]) / camera["fy"] * z
    return np.stack([-x, -y, z], axis=-1).astype(np.float32)


def release() -> None:
    """Free memory after an error."""
    import torch

    torch.cuda.empty_cache()


if __name__ == "__main__":
    main()
