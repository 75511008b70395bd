"""A worker that asks for meshes: `mesh_client.py COMMAND CACHE NAME`, seeds on each line of stdin, hashes on stdout."""

import json
import sys
from pathlib import Path

import numpy as np

from schemas.geometry import Camera
from schemas.identity import content_hash
from tableverse_factory.models.services import Services
from tableverse_factory.stages.place.mesh_service.client import MeshClient, MeshQuery, RgbdImage


def scene_of(name, seeds):
    """A picture of this worker's own, with an object for each seed."""
    color = np.full((4, 6, 3), ord(name[0]), np.uint8)
    masks = [np.arange(24).reshape(4, 6) == seed % 24 for seed in seeds]
    view = RgbdImage(color, np.ones((4, 6), np.float32), Camera(5.0, 5.0, 3.0, 2.0, 6, 4))
    return view, [MeshQuery(mask, seed) for mask, seed in zip(masks, seeds, strict=True)]


def hashes(maker, name, seeds):
    return [
        getattr(answer, "data", b"") and content_hash(answer.data)
        for answer in maker.make_meshes(*scene_of(name, seeds))
    ]


def main():
    command, cache, name = sys.argv[1:]
    maker = MeshClient(tuple(json.loads(command)), 20.0, Services(Path(cache)))
    for line in sys.stdin:
        sys.stdout.write(json.dumps(hashes(maker, name, json.loads(line))) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
