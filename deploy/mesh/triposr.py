"""TripoSR behind the mesh protocol. Runs in that model's own environment: see docs/mesh-process.md.

python triposr.py --checkout TripoSR --weights stabilityai/TripoSR
"""

import argparse
import io
import os
import sys
from pathlib import Path
from typing import Any

from protocol import MakeMeshes, MeshFile, MeshOrder, ModelInfo, hash_names, load_box, serve

FOREGROUND = 0.85
"""Share of the picture's side that the object takes, as in training."""
GREY = 127
CHUNK = 8192
FILES = ("config.yaml", "model.ckpt")


def main() -> None:
    """Parse the command line and serve."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--checkout", type=Path, default=Path("TripoSR"), help="clone of VAST-AI-Research's")
    parser.add_argument("--weights", default="stabilityai/TripoSR", help="folder, or on the hub NAME or NAME@REVISION")
    parser.add_argument("--version", default="1", help="of code and weights; another one asks everything again")
    parser.add_argument("--resolution", type=int, default=256, help="of marching cubes")
    parser.add_argument("--batch", type=int, default=4, help="objects at a time; 1 on a slow CPU")
    parser.add_argument("--device", help="default: cuda:0 where there is one, else cpu")
    parser.add_argument("--self-test", action="store_true", help="answer with boxes, load nothing")
    options = parser.parse_args()
    if options.self_test:
        serve(ModelInfo("self-test", "1", "CC0-1.0"), load_box)
        return
    of = hash_names(options.checkout, options.weights, Path(options.weights) / "config.yaml")
    at = f"{options.resolution}, {options.batch} at a time"
    info = ModelInfo("triposr", f"{options.version} of {of} at {at}", "MIT")
    serve(info, lambda: load(options), options.batch, release)


def load(options: argparse.Namespace) -> MakeMeshes:
    """Load the model on the device.

    The weights are a pickle (`model.ckpt`) that the model's code loads with torch's defaults; the variable below keeps
    all versions of torch from running code in it.
    """
    os.environ["TORCH_FORCE_WEIGHTS_ONLY_LOAD"] = "1"
    sys.path.insert(0, str(options.checkout))
    import torch
    from tsr.system import TSR

    device = options.device or ("cuda:0" if torch.cuda.is_available() else "cpu")
    model = TSR.from_pretrained(resolve_weights(options.weights), config_name=FILES[0], weight_name=FILES[1])
    model.renderer.set_chunk_size(CHUNK)
    model.to(device)

    def make(orders: Any, size: int) -> list[MeshFile]:
        pictures = [crop_on_grey(order) for order in orders]
        pictures += pictures[-1:] * (size - len(pictures))
        with torch.no_grad():
            codes = model(pictures, device=device)[: len(orders)]
            meshes = model.extract_mesh(codes, True, resolution=options.resolution)
        # Its world is x towards the camera, y right, z up; PLY keeps the coordinates as they are.
        return [MeshFile(mesh.export(file_type="ply"), "ply", "z") for mesh in meshes]

    return make


def resolve_weights(weights: str) -> str:
    """Download weights with a revision and return their folder; other names are returned as they are."""
    name, _, revision = weights.partition("@")
    if not revision or Path(weights).is_dir():
        return weights
    from huggingface_hub import hf_hub_download

    config, _ = (hf_hub_download(name, file, revision=revision) for file in FILES)
    return str(Path(config).parent)


def crop_on_grey(order: MeshOrder) -> Any:
    """Return a picture of the object alone, in the middle of a grey square."""
    import numpy as np
    from PIL import Image

    image = np.array(Image.open(io.BytesIO(order.picture)).convert("RGB"))
    mask = np.array(Image.open(io.BytesIO(order.mask))) > 0
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    window = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    cut = np.where(mask[window][..., None], image[window], GREY).astype(np.uint8)
    side = max(1, round(max(cut.shape[:2]) / FOREGROUND))
    square = np.full((side, side, 3), GREY, dtype=np.uint8)
    top, left = (side - cut.shape[0]) // 2, (side - cut.shape[1]) // 2
    square[top : top + cut.shape[0], left : left + cut.shape[1]] = cut
    return Image.fromarray(square)


def release() -> None:
    """Free memory after an error."""
    import torch

    if torch.cuda.is_available():
        torch.cuda.empty_cache()


if __name__ == "__main__":
    main()
