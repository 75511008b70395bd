"""A mesh process as somebody would write one from docs/mesh-process.md alone: nothing of ours is imported.

`mesh_server.py BEHAVIOUR [FOLDER]`: gives a tetrahedron, or the true meshes of the captures in FOLDER; misbehaves as it
is told at objects whose seed ends in 666. MESH_LOG names a file that gets a line for everything that is asked.
"""

import hashlib
import json
import os
import struct
import sys
import time
from pathlib import Path

TETRAHEDRON = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
BAD_SEED = 666
HELLO = {"type": "hello", "protocol": 1, "model": "tetra", "version": "1", "licence": "CC0-1.0", "wants": ["seed"]}
STRANGE = {
    "empty": b"# nothing\n",
    "nan": TETRAHEDRON.replace(b"v 1 0 0", b"v nan 0 0"),
    "nonsense": b"\xff" * 1000,
    "sheet": b"v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n",
}
HEADS = {
    "stranger": {"type": "mesh", "id": "77", "format": "obj", "up": "z", "parts": []},
    "no type": {"parts": []},
    "list": [1, 2],
    "negative": {"type": "mesh", "id": "1", "parts": [-1]},
    "gigabyte": {"type": "mesh", "id": "1", "format": "obj", "up": "z", "parts": [1 << 30]},
    "many": {"type": "mesh", "id": "1", "parts": [1] * 1000},
}


def read(stream):
    start = stream.read(4)
    if len(start) < 4:
        return None
    head = json.loads(stream.read(struct.unpack("<I", start)[0]))
    return head, [stream.read(size) for size in head["parts"]]


def write(head, *parts):
    if isinstance(head, dict):
        head = {"parts": [len(part) for part in parts], **head}
    data = json.dumps(head).encode()
    sys.stdout.buffer.write(struct.pack("<I", len(data)) + data + b"".join(parts))
    sys.stdout.buffer.flush()


def note(line):
    with Path(os.environ.get("MESH_LOG", os.devnull)).open("a") as file:
        file.write(f"{line} {os.getpid()}\n")


def first_time():
    flag = Path(os.environ["MESH_LOG"]).with_suffix(".flag")
    was_there = flag.exists()
    flag.touch()
    return not was_there


def misbehave(behaviour, name):
    """True where the object was answered."""
    if behaviour.endswith(" once") and not first_time():
        return False
    behaviour = behaviour.removesuffix(" once")
    if behaviour == "crash":
        sys.exit("Traceback (most recent call last):\n  nothing to see\nRuntimeError: the GPU is on fire")
    if behaviour == "hang":
        time.sleep(1000)
    if behaviour == "gate":
        while not Path(os.environ["MESH_LOG"]).with_suffix(".gate").exists():
            time.sleep(0.01)
    if behaviour == "print":
        print("Loading pipeline components...", flush=True)  # noqa: T201 where it does not belong
    if behaviour == "half":
        sys.stdout.buffer.write(struct.pack("<I", 5000) + b'{"type": "mesh"')
        sys.stdout.buffer.flush()
        sys.exit(0)
    if behaviour == "close":
        os.close(1)
        time.sleep(1000)
    if behaviour == "drip":
        write(
            {"type": "mesh", "id": "1", "format": "obj", "up": "z", "parts": [1000]},
        )
        while True:
            sys.stdout.buffer.write(b"#")
            sys.stdout.buffer.flush()
            time.sleep(0.05)
    if behaviour in HEADS:
        head = HEADS[behaviour]
        write({"id": name, **head} if isinstance(head, dict) else head)
        time.sleep(1000)
    return False


def true_mesh(folder, mask_png):
    """The true mesh of the instance under a mask, as a GLB with y up, its longest side 1."""
    import io

    import numpy as np
    import trimesh
    from PIL import Image

    mask = np.array(Image.open(io.BytesIO(mask_png))) > 0
    best, share = None, 0.0
    for capture in sorted(Path(folder).glob("*/masks.png")):
        ids = np.array(Image.open(capture))
        for entry in json.loads((capture.parent / "truth.json").read_text())["objects"]:
            own = ids == entry["instance_id"] if ids.shape == mask.shape else np.zeros(1, bool)
            iou = (own & mask).sum() / max((own | mask).sum(), 1) if own.shape == mask.shape else 0.0
            if iou > share:
                best, share = capture.parent / entry["mesh"], iou
    mesh = trimesh.load(best, force="mesh", process=False)
    low, high = mesh.bounds
    vertices = (mesh.vertices - (low + high) / 2) / (high - low).max()
    y_up = vertices @ np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]).T
    return trimesh.Trimesh(y_up, mesh.faces, process=False).export(file_type="glb")


def answer(head, parts, behaviour, folder):
    for entry in head["objects"]:
        note(f"make {entry['seed']}")
        bad = entry["seed"] % 1000 == BAD_SEED
        mesh = {"type": "mesh", "id": entry["id"], "format": "obj", "up": "z"}
        if bad and misbehave(behaviour, entry["id"]):
            continue
        if bad and behaviour == "fail":
            write({"type": "failed", "id": entry["id"], "reason": "nothing in the mask \x1b[31m\n" + 1000 * "x"})
        elif bad and behaviour == "no up":
            write({"type": "mesh", "id": entry["id"], "format": "obj"}, TETRAHEDRON)
        elif bad and behaviour in STRANGE:
            write(mesh, STRANGE[behaviour])
        elif folder:
            write({**mesh, "format": "glb", "up": "y"}, true_mesh(folder, parts[entry["mask"]]))
        elif behaviour == "gate":
            picture = parts[head["pictures"][entry["picture"]]["picture"]]
            seen = hashlib.sha256(picture + parts[entry["mask"]]).hexdigest()
            write(mesh, TETRAHEDRON + f"# {entry['seed']} {seen}\n".encode())
        else:
            write(mesh, TETRAHEDRON)


def main():
    behaviour, folder = sys.argv[1], sys.argv[2] if len(sys.argv) > 2 else None
    note("start")
    if behaviour == "no package":
        import sam3d_objects_that_nobody_has  # noqa: F401
    if behaviour == "other protocol":
        write({**HELLO, "protocol": 2})
    if behaviour == "mute":
        time.sleep(1000)
    write(HELLO)
    if behaviour == "stuck":
        time.sleep(1000)
    while (message := read(sys.stdin.buffer)) is not None:
        head, parts = message
        if head["type"] == "load":
            note("load")
            if behaviour == "no weights":
                sys.exit("FileNotFoundError: checkpoints/hf/pipeline.yaml")
            write({"type": "ready"})
            continue
        if behaviour == "chatter":
            sys.stderr.write("step 1/25\n" * 300_000)
        if behaviour == "gate":
            note(f"request of {len(head['objects'])}")
            note(f"named {' '.join(entry['id'] for entry in head['objects'])}")
        answer(head, parts, behaviour, folder)


if __name__ == "__main__":
    main()
