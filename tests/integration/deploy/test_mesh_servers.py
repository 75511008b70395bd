"""The model's side of the mesh protocol; packages that answer as theirs do stand in for the models themselves."""

import io
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import httpx
import numpy as np
import pytest
from PIL import Image

from schemas.geometry import Camera
from tableverse_factory.core.errors import ModelAccessError
from tableverse_factory.models.services import Services
from tableverse_factory.stages.place.mesh_service.client import MeshClient, MeshFile, MeshQuery, RgbdImage
from tableverse_factory.stages.place.mesh_service.model_completion import convert_mesh
from tests.helpers.mesh_daemons import daemons_inside
from tests.helpers.paths import ROOT
from tests.helpers.weights_hub import Model, weights_hub

HERE = ROOT / "deploy" / "mesh"

# As notebook/inference.py of SAM 3D Objects: what it is called with is checked, a box 1 x 2 (up) x 3 comes back.
SAM_3D = """
import numpy as np, torch, trimesh
print("Loading pipeline components...")
class Inference:
    def __init__(self, config_file, compile=False):
        assert config_file.endswith("checkpoints/hf/pipeline.yaml") and compile is False
        self._pipeline = Pipeline()
class Pipeline:
    def run(self, image, mask=None, seed=None, stage1_only=False, with_mesh_postprocess=True, with_texture_baking=True,
            with_layout_postprocess=False, use_vertex_color=False, pointmap=None):
        assert not (stage1_only or with_mesh_postprocess or with_texture_baking or with_layout_postprocess)
        assert use_vertex_color and mask is None
        assert image.shape == (4, 6, 4) and image.dtype == np.uint8 and image[0, 5].tolist() == [9, 8, 7, 0]
        assert sorted(image[..., 3].ravel())[-3:] == [0, 255, 255]
        assert seed == 5
        assert isinstance(pointmap, torch.Tensor) and pointmap.dtype == torch.float32 and pointmap.shape == (4, 6, 3)
        assert torch.isnan(pointmap[0, 0]).all()
        print("step 1/25")
        return {"glb": trimesh.creation.box((1, 2, 3)), "rotation": None, "translation": None, "scale": None}
"""

# As tsr/system.py of TripoSR: more than two pictures at a time do not fit into its memory.
TRIPOSR = """
import os, trimesh
from tests.helpers.paths import ROOT
class Renderer:
    def set_chunk_size(self, size): assert size == 8192
class TSR:
    renderer = Renderer()
    @classmethod
    def from_pretrained(cls, pretrained_model_name_or_path, config_name, weight_name):
        assert (pretrained_model_name_or_path, config_name, weight_name) == ("folder", "config.yaml", "model.ckpt")
        assert os.environ["TORCH_FORCE_WEIGHTS_ONLY_LOAD"] == "1"
        return cls()
    def to(self, device): assert device == "cpu"
    def __call__(self, image, device):
        if len(image) > 2: raise RuntimeError("CUDA out of memory. Tried to allocate 2.00 GiB")
        assert len(image) == 2, "whatever is asked for, the shape is the same"
        return [picture.size for picture in image]
    def extract_mesh(self, scene_codes, has_vertex_color, resolution=256, threshold=25.0):
        assert has_vertex_color is True and resolution == 64 and len(scene_codes) <= 2
        return [trimesh.creation.box((1, 2, 3), vertex_colors=[200, 30, 20, 255]) for _ in scene_codes]
"""


@pytest.fixture
def module(monkeypatch: pytest.MonkeyPatch) -> Iterator[object]:
    """Imports a file of the folder as its own process does, and forgets it again."""
    monkeypatch.syspath_prepend(HERE)

    def load(name: str) -> ModuleType:
        return __import__(name)

    yield load
    for name in ("protocol", "sam3d", "triposr"):
        sys.modules.pop(name, None)


@pytest.fixture
def inside(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    with daemons_inside(monkeypatch):
        yield


def png(array: np.ndarray) -> bytes:
    data = io.BytesIO()
    Image.fromarray(array).save(data, "PNG")
    return data.getvalue()


def test_a_batch_that_does_not_fit_is_halved_and_one_bad_object_costs_itself(module):
    protocol = module("protocol")
    released: list[int] = []

    def make(orders, size):
        assert len(orders) <= size
        if size > 2:
            raise RuntimeError("CUDA out of memory")
        if "bad" in orders:
            raise ValueError("nothing in the mask")
        return [order.upper() for order in orders]

    answers = protocol.make_all(make, ["a", "b", "c", "bad", "d"], 8, lambda: released.append(1))
    assert answers == ["A", "B", "C", "ValueError: nothing in the mask", "D"]
    assert released


def test_a_bad_object_changes_no_shape_in_which_its_neighbours_are_made(module):
    def make(orders, size):
        if "bad" in orders:
            raise ValueError("nothing in the mask")
        return [(order, size) for order in orders]

    make_all = module("protocol").make_all
    assert make_all(make, ["a", "bad", "b"], 4, lambda: None) == [("a", 4), "ValueError: nothing in the mask", ("b", 4)]
    assert make_all(make, ["a"], 4, lambda: None) == [("a", 4)]


def test_one_object_that_never_fits_has_none(module):
    sizes = []

    def make(orders, size):
        sizes.append(size)
        raise MemoryError

    assert module("protocol").make_all(make, ["a", "b"], 4, lambda: None) == ["MemoryError: "] * 2
    assert sizes == [4, 2, 1, 1]


def test_a_gpu_that_is_lost_ends_the_process_and_blames_no_object(module):
    def make(orders, size):
        raise RuntimeError("CUDA error: device-side assert triggered")

    with pytest.raises(RuntimeError, match="device-side"):
        module("protocol").make_all(make, ["a"], 4, lambda: None)


def test_other_weights_or_settings_are_another_version(tmp_path):
    config = tmp_path / "pipeline.yaml"
    versions = []
    for text, options in (
        ("a", ["sam3d.py", "--config", config]),
        ("b", ["sam3d.py", "--config", config]),
        ("b", ["sam3d.py", "--config", tmp_path / "other.yaml"]),
        ("b", ["triposr.py", "--weights", "A"]),
        ("b", ["triposr.py", "--weights", "B"]),
        ("b", ["triposr.py", "--weights", "B"]),
    ):
        config.write_text(text)
        line = [sys.executable, "-S", "-E", HERE / options[0], *options[1:]]
        hello = json.loads(subprocess.run(line, input=b"", capture_output=True, check=True).stdout)
        versions.append((hello["model"], hello["version"]))
    assert len(set(versions)) == 5


@pytest.mark.parametrize("name", ["sam3d.py", "triposr.py"])
def test_the_scripts_need_nothing_but_python_until_they_load_weights(name):
    done = subprocess.run(
        [sys.executable, "-S", "-E", HERE / name, "--self-test"], input=b"", capture_output=True, check=True
    )
    assert b'"model": "self-test"' in done.stdout


def test_a_pointmap_has_the_axes_of_pytorch3d(module):
    depth = np.zeros((4, 6), "<f4")
    depth[3, 5] = 2.0
    camera = {"fx": 5.0, "fy": 4.0, "cx": 3.0, "cy": 2.0}
    order = module("protocol").MeshOrder(b"", b"", 0, depth.tobytes(), camera)
    points = module("sam3d").build_pointmap(order, (4, 6))
    assert np.isnan(points[0, 0]).all()
    # To the right of the middle and below it: x is to the left there, y up, z ahead.
    np.testing.assert_allclose(points[3, 5], [-0.8, -0.5, 2.0])


def test_triposr_is_shown_the_object_alone_in_the_middle_of_grey(module):
    picture = np.full((60, 80, 3), 10, np.uint8)
    picture[10:44, 60:77] = (250, 0, 0)
    mask = np.zeros((60, 80), np.uint8)
    mask[10:44, 60:77] = 255
    order = module("protocol").MeshOrder(png(picture), png(mask), 0, None, {})
    shown = np.array(module("triposr").crop_on_grey(order))
    assert shown.shape == (40, 40, 3)  # 34 rows are 85 %
    red = (shown == (250, 0, 0)).all(axis=-1)
    assert (np.argwhere(red).min(axis=0).tolist(), np.argwhere(red).max(axis=0).tolist()) == ([3, 11], [36, 27])
    assert (shown[~red] == 127).all()


def test_triposr_takes_weights_at_a_revision_of_the_hub(module, monkeypatch, tmp_path):
    resolve_weights = module("triposr").resolve_weights
    with weights_hub(monkeypatch, tmp_path / "cache") as hub:
        model = hub.models["someone/triposr"] = Model()
        for text in ("old", "new"):
            (tmp_path / text).mkdir()
            for name in ("config.yaml", "model.ckpt"):
                (tmp_path / text / name).write_text(text)
            model.commit(tmp_path / text, branch=text)
        found = Path(resolve_weights("someone/triposr@old"))
        assert sorted((path.name, path.read_text()) for path in found.iterdir()) == [
            ("config.yaml", "old"),
            ("model.ckpt", "old"),
        ]
    assert resolve_weights("someone/triposr") == "someone/triposr"
    assert resolve_weights(str(tmp_path)) == str(tmp_path)


def asked(command: list[object], folder: Path, count: int) -> list[MeshFile | str]:
    color = np.zeros((4, 6, 3), np.uint8)
    color[0, 5] = (9, 8, 7)
    depth = np.ones((4, 6), np.float32)
    depth[0, 0] = 0.0
    view = RgbdImage(color, depth, Camera(5.0, 5.0, 3.0, 2.0, 6, 4))
    masks = [np.arange(24).reshape(4, 6) // 2 == 3 + k for k in range(count)]
    line = (sys.executable, *map(str, command))
    return MeshClient(line, 60.0, Services(folder / "cache")).make_meshes(view, [MeshQuery(mask, 5) for mask in masks])


def test_only_who_was_told_the_address_is_answered():
    line = [sys.executable, "-S", "-E", HERE / "sam3d.py", "--self-test"]
    with subprocess.Popen(line, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        url = httpx.URL(json.loads(process.stdout.readline())["url"])
        question = {"pictures": [], "objects": []}
        assert httpx.post(url.copy_with(path="/meshes"), json=question).status_code == 404
        assert httpx.post(f"{url}/meshes", json=question).json() == {"meshes": []}
        process.communicate()
    assert process.returncode == 0


def test_a_model_that_cannot_be_loaded_ends_the_process_with_its_error_as_the_last_line(inside, tmp_path):
    with pytest.raises(
        ModelAccessError, match="does not load: it ended with exit code 1; it says: ModuleNotFoundError"
    ):
        asked([HERE / "triposr.py", "--checkout", tmp_path], tmp_path, 1)


@pytest.mark.slow
def test_sam_3d_objects_is_called_as_its_package_wants(inside, tmp_path):
    (tmp_path / "notebook").mkdir()
    (tmp_path / "notebook" / "inference.py").write_text(SAM_3D)
    (answer,) = asked([HERE / "sam3d.py", "--checkout", tmp_path], tmp_path, 1)
    assert isinstance(answer, MeshFile), answer
    assert (answer.format, answer.up) == ("glb", "y")
    np.testing.assert_allclose(3.0 * np.ptp(convert_mesh(answer).vertices, axis=0), [1, 3, 2], atol=1e-6)


@pytest.mark.slow
def test_triposr_is_called_as_its_package_wants_and_memory_that_is_short_halves_the_batch(inside, tmp_path):
    (tmp_path / "tsr").mkdir()
    (tmp_path / "tsr" / "system.py").write_text(TRIPOSR)
    options = ["--checkout", tmp_path, "--weights", "folder", "--resolution", 64, "--device", "cpu"]
    answers = asked([HERE / "triposr.py", *options], tmp_path, 5)
    for answer in answers:
        assert isinstance(answer, MeshFile), answer
        mesh = convert_mesh(answer)
        np.testing.assert_allclose(3.0 * np.ptp(mesh.vertices, axis=0), [1, 2, 3], atol=1e-6)
        assert mesh.vertex_colors is not None
        assert mesh.vertex_colors[0].tolist() == [200, 30, 20]
