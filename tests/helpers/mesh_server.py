"""A mesh process as somebody would write one from docs/mesh-process.md alone: nothing of ours is imported.

`mesh_server.py BEHAVIOUR [FOLDER]`: gives a tetrahedron, or the true meshes of the captures in FOLDER; misbehaves as it
is told at objects whose seed ends in 666. MESH_LOG names a file that gets a line for everything that is asked.
"""

import base64
import hashlib
import json
import os
import sys
import threading
import time
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

TETRAHEDRON = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
BAD_SEED = 666
HELLO = {"protocol": 2, "model": "tetra", "version": "1", "licence": "CC0-1.0", "wants": ["seed"]}
STRANGE = {
    "empty": b"# nothing\n",
    "nan": TETRAHEDRON.replace(b"v 1 0 0", b"v nan 0 0"),
    "nonsense": b"\xff" * 1000,
    "sheet": b"v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n",
}
BODIES = {
    "nothing": {},
    "list": [1, 2],
    "no entry": {"meshes": [7]},
    "no data": {"meshes": [{"format": "obj", "up": "z"}]},
    "not base64": {"meshes": [{"data": "v 0 0 0", "format": "obj", "up": "z"}]},
    "too many": {"meshes": [{"error": "one"}, {"error": "two"}]},
    "long": {"meshes": [{"data": "A" * 100_000, "format": "obj", "up": "z"}]},
}


def note(line):
    with Path(os.environ.get("MESH_LOG", os.devnull)).open("a") as file:
        file.write(f"{line} {os.getpid()}\n")


def first_time():
    flag = Path(os.environ["MESH_LOG"]).with_suffix(".flag")
    was_there = flag.exists()
    flag.touch()
    return not was_there


def misbehave(behaviour, handler):
    """True where the request was answered."""
    if behaviour.endswith(" once") and not first_time():
        return False
    behaviour = behaviour.removesuffix(" once")
    if behaviour == "crash":
        sys.stderr.write("Traceback (most recent call last):\n  nothing to see\nRuntimeError: the GPU is on fire\n")
        os._exit(1)
    if behaviour == "hang":
        time.sleep(1000)
    if behaviour == "gate":
        while not Path(os.environ["MESH_LOG"]).with_suffix(".gate").exists():
            time.sleep(0.01)
    if behaviour in ("half", "drip"):
        handler.send_response(200)
        handler.send_header("Content-Length", "5000")
        handler.end_headers()
        handler.wfile.write(b'{"meshes": [')
        while behaviour == "drip":
            handler.wfile.write(b" ")
            time.sleep(0.05)
        os._exit(0)
    if behaviour == "close":
        return True
    if behaviour == "refuse":
        handler.send_error(404)
        return True
    if behaviour in BODIES:
        handler.reply(BODIES[behaviour])
        return True
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


def make(question, entry, behaviour, folder):
    bad = entry["seed"] % 1000 == BAD_SEED
    if bad and behaviour == "fail":
        return {"error": "nothing in the mask \x1b[31m\n" + 1000 * "x"}
    mask = base64.b64decode(entry["mask"])
    data, form, up = TETRAHEDRON, "obj", "z"
    if bad and behaviour == "no up":
        up = None
    elif bad and behaviour in STRANGE:
        data = STRANGE[behaviour]
    elif folder:
        data, form, up = true_mesh(folder, mask), "glb", "y"
    elif behaviour == "gate":
        picture = base64.b64decode(question["pictures"][entry["picture"]]["picture"])
        seen = hashlib.sha256(picture + mask).hexdigest()
        data += f"# {entry['seed']} {seen}\n".encode()
    return {"data": base64.b64encode(data).decode(), "format": form, "up": up}


class Handler(BaseHTTPRequestHandler):
    behaviour, folder, loaded = "", None, False

    def do_POST(self):
        question = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        if not Handler.loaded:
            note("load")
            if self.behaviour == "no weights":
                sys.stderr.write("FileNotFoundError: checkpoints/hf/pipeline.yaml\n")
                os._exit(1)
            Handler.loaded = True
        if self.behaviour == "chatter":
            sys.stderr.write("step 1/25\n" * 300_000)
            sys.stdout.write("step 1/25\n" * 300_000)
        if self.behaviour == "gate" and question["objects"]:
            note(f"request of {len(question['objects'])}")
        meshes = []
        for entry in question["objects"]:
            note(f"make {entry['seed']}")
            if entry["seed"] % 1000 == BAD_SEED and misbehave(self.behaviour, self):
                return
            meshes.append(make(question, entry, self.behaviour, self.folder))
        self.reply({"meshes": meshes})

    def reply(self, body):
        data = json.dumps(body).encode()
        self.send_response(200)
        self.end_headers()
        self.wfile.write(data)

    def log_message(self, *_):
        pass


def main():
    Handler.behaviour, Handler.folder = sys.argv[1], sys.argv[2] if len(sys.argv) > 2 else None
    note("start")
    if Handler.behaviour == "no package":
        import sam3d_objects_that_nobody_has  # noqa: F401
    if Handler.behaviour == "mute":
        time.sleep(1000)
    server = HTTPServer(("127.0.0.1", 0), Handler)
    hello = {**HELLO, "url": f"http://127.0.0.1:{server.server_port}", "batch": int(os.environ.get("MESH_BATCH", "1"))}
    strange = {"other protocol": {"protocol": 3}, "elsewhere": {"url": "http://192.0.2.1"}, "unnamed": {"model": ""}}
    print("Loading pipeline components...")  # noqa: T201 before the hello
    print(json.dumps({**hello, **strange.get(Handler.behaviour, {})}), flush=True)  # noqa: T201
    if Handler.behaviour == "stuck":
        time.sleep(1000)
    threading.Thread(target=lambda: (sys.stdin.read(), os._exit(0)), daemon=True).start()
    server.serve_forever()


if __name__ == "__main__":
    main()
