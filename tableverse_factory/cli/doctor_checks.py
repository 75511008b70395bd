"""Checks of this machine, each with a remedy.

Checks that may hang or crash (native libraries, renderers, Ray) run in processes of their own, with a deadline.
"""

import ctypes
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path

from tableverse_factory.core.text import sanitize_line
from tableverse_factory.stages.observe.depth.from_git import PACKAGES

SCRIPT_TIMEOUT_S = 120.0
MIN_FREE_BYTES = 2 * 1024**3
MIN_MEMORY_BYTES = 2 * 1024**3
SYSTEM_LIBRARIES = {  # that Open3D loads, with their Debian packages
    "libusb-1.0.so.0": "libusb-1.0-0",
    "libGL.so.1": "libgl1",
    "libgomp.so.1": "libgomp1",
    "libX11.so.6": "libx11-6",
}
EXTRAS = {  # of pyproject.toml, without `dev` and `docs`: packages and purpose
    "cluster": (("aiohttp",), "builds as jobs of a Ray cluster, Ray's dashboard"),
    "s3": (("s3fs",), "datasets in object stores"),
    "vlm": (("google-genai", "openai"), "detectors and judges that are models behind an address"),
    "episodes": (("av", "h5py"), "trajectories as LeRobot and robomimic datasets"),
    "robots": (("mujoco-menagerie",), "other arms, by the name menagerie:NAME"),
    "viewer": (("viser",), "tableverse view"),
    "hub": (("huggingface_hub",), "tableverse publish, datasets by hf://"),
    "gym": (("gymnasium",), "a scene and a task as an environment"),
    "warp": (("mujoco-warp",), "thousands of scenes at once on a GPU, verify --engine warp"),
    "newton": (("newton",), "verify --engine newton"),
    "usd": (("usd-core",), "tableverse extract --format usd"),
    "models": (
        ("torch", "transformers"),
        "real models instead of the embedded ones, depth_anything_2 among them; tableverse train",
    ),
    "training": (("cupy-cuda13x", "onnx"), "tableverse train picture on a GPU"),
    "bench": (("pandas",), "the comparison of tableverse bench with Ray Data"),
}
_SIMULATOR = """
import mujoco
model = mujoco.MjModel.from_xml_string('<mujoco><worldbody><geom size=".1"/></worldbody></mujoco>')
mujoco.mj_step(model, mujoco.MjData(model))
print(mujoco.__version__)
"""
_RENDERER = """
import numpy as np
from schemas.geometry import Camera, TriangleMesh
from tableverse_factory.physics.render.render import look_at, render
wall = TriangleMesh(np.array([[-9.0, 0, -9], [9, 0, -9], [0, 0, 9]]), np.array([[0, 1, 2]], dtype=np.int32))
eye = look_at(np.array([0.0, -1, 0]), np.zeros(3))
depth = render([wall], Camera(30.0, 30.0, 15.5, 11.5, 32, 24), eye).depth
assert abs(depth - 1).max() < 1e-3, depth
print("renders what it should")
"""
_GL_RENDERER = """
import mujoco
model = mujoco.MjModel.from_xml_string('<mujoco><worldbody><geom size=".1"/></worldbody></mujoco>')
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
with mujoco.Renderer(model, 48, 64) as renderer:
    renderer.update_scene(data)
    print("renders", renderer.render().shape)
"""
_RAY = """
import ray
ray.init(num_cpus=1, include_dashboard=False, log_to_driver=False, logging_level="ERROR")
assert ray.get(ray.remote(lambda: 41).remote(), timeout=60) == 41
print(ray.__version__, "starts and answers")
"""
_run = partial(subprocess.run, capture_output=True, text=True, errors="replace", check=False)


@dataclass(frozen=True, slots=True)
class Check:
    """Result of one check, with a remedy unless all is well."""

    name: str
    required: bool  # by a build
    ok: bool
    found: str
    advice: str = ""


def run_checks(cache_dir: Path, out_dir: Path) -> Iterator[Check]:
    """Run the checks one after another; takes some seconds, mostly for Ray."""
    is_new = sys.version_info >= (3, 11)
    found = ".".join(map(str, sys.version_info[:3]))
    yield Check("Python", True, is_new, found, "" if is_new else "install 3.11 or newer")
    yield from _check_libraries()
    yield _check_script("simulator (MuJoCo)", _SIMULATOR, "pip install --force-reinstall mujoco")
    yield _check_script("renderer (Embree, on the CPU)", _RENDERER, "install the system libraries above")
    yield _check_mujoco_renderer()
    yield _check_script("Ray", _RAY, "see the message; `tableverse build --executor local` works without it")
    yield _check_gpu()
    yield from _check_extras()
    yield _check_writable(cache_dir)
    yield _check_free_space("disk, cache", cache_dir)
    yield _check_free_space("disk, here", out_dir)
    yield _check_memory()


def _check_libraries() -> Iterator[Check]:
    for library, package in SYSTEM_LIBRARIES.items():
        try:
            ctypes.CDLL(library)
        except OSError as error:
            yield Check(f"library {library}", True, False, str(error), f"sudo apt-get install {package}")
        else:
            yield Check(f"library {library}", True, True, "loads")


def _check_script(
    name: str, code: str, advice: str, *, required: bool = True, environment: Mapping[str, str] | None = None
) -> Check:
    """Run a script in a process of its own; the last line of its output is what was found."""
    try:
        ended = _run([sys.executable, "-c", code], timeout=SCRIPT_TIMEOUT_S, env={**os.environ, **(environment or {})})
    except subprocess.TimeoutExpired:
        return Check(name, required, False, f"no answer within {SCRIPT_TIMEOUT_S:g} s", advice)
    ok = ended.returncode == 0
    words = (ended.stdout if ok else ended.stderr).strip() or f"exit code {ended.returncode}"
    return Check(name, required, ok, sanitize_line(words.splitlines()[-1]), "" if ok else advice)


def _check_mujoco_renderer() -> Check:
    """Check the renderer as the environment has it, or else, where it names none, with EGL."""
    name, own = "MuJoCo's own renderer", os.environ.get("MUJOCO_GL")
    advice = "not needed; for pictures by MuJoCo: sudo apt-get install libegl1 libgl1-mesa-dri, and MUJOCO_GL=egl"
    check = _check_script(name, _GL_RENDERER, advice, required=False, environment={"MUJOCO_GL": own or "egl"})
    return (
        replace(check, found=f"{check.found} with MUJOCO_GL=egl, which is not set here")
        if check.ok and not own
        else check
    )


def _check_gpu() -> Check:
    advice = "not needed by the embedded defaults; real models want one, with its driver"
    if shutil.which("nvidia-smi") is None:
        return Check("GPU", False, False, "no nvidia-smi", advice)
    query = ["nvidia-smi", "--query-gpu=name,memory.total", "--format=csv,noheader"]
    try:
        ended = _run(query, timeout=20)
    except (subprocess.TimeoutExpired, OSError) as error:
        return Check("GPU", False, False, str(error)[:200], advice)
    names = [line.strip() for line in ended.stdout.splitlines() if line.strip()]
    ok = ended.returncode == 0 and bool(names)
    return Check("GPU", False, ok, "; ".join(names)[:200] or "none answers", "" if ok else advice)


def _check_extras() -> Iterator[Check]:
    for extra, (packages, gives) in EXTRAS.items():
        found = {package: _find_version(package) for package in packages}
        ok = all(found.values())
        words = ", ".join(f"{package} {version or 'is not installed'}" for package, version in found.items())
        advice = "" if ok else f"not needed; for {gives}: pip install 'tableverse-factory[{extra}]'"
        yield Check(f"extra {extra}", False, ok, words, advice)
    curobo = find_spec("curobo") is not None  # in no extra: it is built for the GPU that is there
    advice = "" if curobo else "not needed; for the planner curobo, on a GPU (docs/trajectories.md): see its own pages"
    yield Check("cuRobo", False, curobo, "installed" if curobo else "not installed", advice)
    for module, (name, source) in PACKAGES.items():  # in no extra: no index has them
        there = find_spec(module) is not None
        advice = "" if there else f"not needed; for pictures without depth (docs/models.md): pip install '{source}'"
        yield Check(f"depth model {name}", False, there, "installed" if there else "not installed", advice)
    yield Check("weights", False, True, "none needed: every model has an embedded default (docs/models.md)")


def _find_version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _check_writable(folder: Path) -> Check:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(b"x")
    except OSError as error:
        advice = "make it writable, or set TABLEVERSE_CACHE to another folder"
        return Check("cache", True, False, f"{folder}: {error.strerror}", advice)
    return Check("cache", True, True, str(folder))


def _check_free_space(name: str, folder: Path) -> Check:
    there = next(parent for parent in (folder.absolute(), *folder.absolute().parents) if parent.exists())
    free = shutil.disk_usage(there).free
    ok = free >= MIN_FREE_BYTES
    return Check(name, True, ok, f"{free / 1024**3:.1f} GiB free", "" if ok else f"make room: {there} needs 2 GiB")


def _check_memory() -> Check:
    total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    ok = total >= MIN_MEMORY_BYTES
    found = f"{total / 1024**3:.1f} GiB, {os.cpu_count()} CPUs"
    return Check("memory", True, ok, found, "" if ok else "a worker wants about 2 GiB: use fewer, or a larger machine")
