"""What is made of the arrays of depth models, and the one that runs here, from weights on the disk."""

import io
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from schemas.config import Config
from schemas.geometry import Camera
from schemas.manifest import ImageRow, SceneKind
from schemas.outcome import Done, Dropped
from tableverse_factory.core.config import build_config
from tableverse_factory.core.errors import ModelAccessError
from tableverse_factory.geometry.math.camera import backproject
from tableverse_factory.models.local.weights import release_models
from tableverse_factory.models.services import Services
from tableverse_factory.stages.observe.depth.depth_anything_2 import compute_input_size
from tableverse_factory.stages.observe.depth.depth_anything_3 import (
    build_nested_estimate,
    mask_unreliable_depth,
    scale_to_metres,
)
from tableverse_factory.stages.observe.depth.from_git import PACKAGES, import_git_package
from tableverse_factory.stages.observe.depth.moge import build_moge_estimate, estimate_moge_2
from tableverse_factory.stages.observe.observe import DEPTH_MODELS, observe
from tableverse_factory.stages.perceive.perceive import perceive
from tests.helpers.depth_weights import save_tiny_depth
from tests.helpers.moge_models import save_thin_moge
from tests.helpers.weights_hub import Model, weights_hub

PUBLIC_GIT_ONLY = ("depth_anything_3", "depth_anything_3_nested", "moge_2")


def photo(path, seed=0, size=(60, 80)):
    Image.fromarray(np.random.default_rng(seed).integers(0, 255, (*size, 3), dtype=np.uint8)).save(path)
    return path


def hide_packages(monkeypatch):
    """Have no package of `PACKAGES`, also where one is installed."""
    for name in [name for name in sys.modules if name.partition(".")[0] in PACKAGES]:
        monkeypatch.delitem(sys.modules, name)
    for name in PACKAGES:
        monkeypatch.setitem(sys.modules, name, None)


def observed(path, **config):
    row = ImageRow(scene_id="a", kind=SceneKind.IMAGE, uri=str(path))
    return observe(row, Config.model_validate({"observe": config}), np.random.default_rng(0), Services(path.parent))


@pytest.mark.parametrize("shrunk", [1.0, 0.128])
def test_metres_of_the_metric_model_do_not_depend_on_how_far_it_shrank_the_picture(shrunk):
    """What the model calls a depth is for 300 px: the same wall has a larger one in a smaller picture."""
    width, height, focal_px = 1000, 750, 800.0
    columns, rows = round(width * shrunk), round(height * shrunk)
    canonical = np.full((rows, columns), 2.0 * 300.0 / (focal_px * shrunk), np.float32)
    found = scale_to_metres(canonical, None, None, focal_px, (height, width))
    np.testing.assert_allclose(found.depth, 2.0, rtol=1e-6)
    assert found.camera.fx == pytest.approx(focal_px * columns / width)
    assert (found.camera.width, found.camera.height) == (columns, rows)


@given(st.floats(0.05, 20.0), st.floats(0.05, 20.0))
def test_the_unit_of_the_confidence_does_not_matter(low, unit):
    confidence = np.full((10, 10), unit, np.float32)
    confidence[:3] = np.float32(unit) * np.float32(0.1)
    kept = mask_unreliable_depth(np.full((10, 10), np.float32(low)), None, confidence) > 0
    assert not kept[:3].any()
    assert kept[3:].all()


@pytest.mark.parametrize("kind", [bool, np.float32])
def test_sky_and_what_is_no_number_are_not_believed(kind):
    depth = np.ones((6, 6), np.float32)
    depth[0, :3] = np.nan, np.inf, -2.0
    sky = np.zeros((6, 6), kind)
    sky[5] = 1
    found = mask_unreliable_depth(depth, sky, None)
    assert np.isfinite(found).all()
    assert (found[0, :3] == 0).all()
    assert (found[5] == 0).all()
    assert (found[1:5] == 1).all()


def test_the_camera_of_the_nested_model_stays_with_its_resolution():
    matrix = np.array([[378.0, 0, 252.0], [0, 380.0, 189.0], [0, 0, 1]])
    found = build_nested_estimate(np.ones((378, 504), np.float32), None, None, matrix)
    assert found.camera == Camera(378.0, 380.0, 251.5, 188.5, 504, 378)


def test_points_of_moge_come_out_of_its_depth_and_camera():
    """Its points are those of pixel centres, in a picture whose edges are 0 and 1."""
    height, width, fx, fy = 30, 40, 0.8, 0.8 * 40 / 30
    depth = np.random.default_rng(0).uniform(0.5, 2.0, (height, width)).astype(np.float32)
    mask = np.ones((height, width), bool)
    mask[:5] = False
    v, u = (np.indices((height, width)) + 0.5) / np.array([height, width])[:, None, None]
    points = np.stack([(u - 0.5) / fx * depth, (v - 0.5) / fy * depth, depth], axis=-1)
    intrinsics = np.array([[fx, 0, 0.5], [0, fy, 0.5], [0, 0, 1]])
    found = build_moge_estimate(np.where(mask, depth, np.inf), mask, intrinsics)
    np.testing.assert_allclose(backproject(found.depth, found.camera)[mask], points[mask], atol=1e-6)
    assert (found.depth[~mask] == 0).all()


@pytest.mark.parametrize("name", PUBLIC_GIT_ONLY)
def test_without_its_package_the_build_stops_and_says_what_to_install(tmp_path, monkeypatch, name):
    hide_packages(monkeypatch)
    with pytest.raises(ModelAccessError, match=r"pip install 'git\+https://github.com/"):
        observed(photo(tmp_path / "a.png"), depth=name, focal_px=100.0, max_file_bytes=10**6)


def test_every_model_that_is_on_git_alone_says_where(monkeypatch):
    hide_packages(monkeypatch)
    for module in PACKAGES:
        with pytest.raises(ModelAccessError, match="is not installed"):
            import_git_package(f"{module}.api")


@given(st.integers(1, 5000), st.integers(1, 5000))
def test_the_size_for_the_model_is_whole_patches_near_the_pictures_aspect(height, width):
    rows, columns = compute_input_size(height, width, 14)
    assert rows % 14 == columns % 14 == 0
    assert 518 in (rows, columns)
    if max(height, width) < 4 * min(height, width):
        assert columns / rows == pytest.approx(width / height, rel=0.06)


def test_the_size_for_the_model_is_that_of_its_own_processor():
    sizes = {(240, 320): (392, 518), (400, 500): (420, 518), (480, 640): (518, 686), (1536, 2048): (518, 686)}
    assert {size: compute_input_size(*size, 14) for size in sizes} == sizes


@pytest.mark.parametrize("size", [(20, 2048), (2048, 20), (100, 801)])
def test_a_strip_is_dropped_before_any_model_sees_it(tmp_path, size):
    outcome = observed(photo(tmp_path / "a.png", size=size), depth="depth_anything_2", focal_px=100.0)
    assert isinstance(outcome, Dropped)
    assert outcome.reason == "picture_too_narrow"


@pytest.mark.heavy
@pytest.mark.filterwarnings("ignore:In CPU autocast", "ignore:xFormers")
@pytest.mark.parametrize("from_hub", [False, True])
def test_moge_gives_the_points_of_its_own_package(tmp_path, monkeypatch, from_hub):
    """Runs where its package is installed, with random weights."""
    package = pytest.importorskip("moge.model.v2", reason="MoGe's own package is not installed")
    torch = pytest.importorskip("torch")
    folder = tmp_path / "weights"
    folder.mkdir()
    save_thin_moge(folder)
    path = photo(tmp_path / "a.png", size=(90, 120))
    with weights_hub(monkeypatch, tmp_path / "cache") as hub:
        hub.models["someone/moge"] = Model()
        named = f"someone/moge@{hub.models['someone/moge'].commit(folder)}" if from_hub else str(folder)
        config = build_config({"observe": {"depth": "moge_2", "depth_weights": named}, "models": {"device": "cpu"}})
        found = estimate_moge_2(ImageRow(scene_id="a", kind=SceneKind.IMAGE, uri=str(path)), config)
    model = package.MoGeModel.from_pretrained(str(folder / "model.pt")).eval()
    pixels = torch.from_numpy(np.array(Image.open(path))).permute(2, 0, 1) / 255.0
    theirs = model.infer(pixels, use_fp16=False)
    kept = theirs["mask"].numpy() & (found.depth > 0)
    assert kept.mean() > 0.5
    points = backproject(found.depth, found.camera)[kept]
    np.testing.assert_allclose(points, theirs["points"].numpy()[kept], atol=1e-5)
    release_models()


MOGE = """
class MoGeModel:
    def from_pretrained(name, **at):
        raise OSError("not a repository")
"""


@pytest.mark.parametrize("weights", ["", "folder"])
def test_weights_of_a_package_on_git_that_cannot_be_had_stop_the_build(tmp_path, monkeypatch, weights):
    """The package is a stand-in: the real one would ask the hub."""
    (tmp_path / "moge" / "model").mkdir(parents=True)
    for package in ("moge", "moge/model"):
        (tmp_path / package / "__init__.py").touch()
    (tmp_path / "moge" / "model" / "v2.py").write_text(MOGE)
    monkeypatch.syspath_prepend(tmp_path)
    for module in [name for name in sys.modules if name.partition(".")[0] == "moge"]:
        monkeypatch.delitem(sys.modules, module)
    named = str(tmp_path / weights) if weights else ""
    (tmp_path / "folder").mkdir()
    with pytest.raises(ModelAccessError, match=r"observe\.depth_weights.* cannot be loaded: OSError: not a repository"):
        observed(photo(tmp_path / "a.png"), depth="moge_2", depth_weights=named)
    for module in ("moge", "moge.model", "moge.model.v2"):
        sys.modules.pop(module, None)


def test_a_depth_model_has_time_to_load_where_no_deadline_is_set():
    config = Config.model_validate({"observe": {"depth": "moge_2"}})
    assert config.get_deadline("observe") > 1000.0
    assert Config().get_deadline("observe") == Config().run.deadline_s


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """A metric and a relative model, tiny and with random weights."""
    folders = {kind: tmp_path_factory.mktemp(kind) for kind in ("metric", "relative")}
    for kind, folder in folders.items():
        save_tiny_depth(folder, kind)
    yield folders
    release_models()


@pytest.mark.heavy
def test_depth_anything_2_runs_from_a_folder_and_gives_the_same_bytes_again(tmp_path, weights):
    path = photo(tmp_path / "a.png", size=(120, 160))
    config = {
        "depth": "depth_anything_2",
        "depth_weights": str(weights["metric"]),
        "focal_px": 150.0,
        "max_depth_m": 20.0,
    }
    outcome = observed(path, **config)
    assert isinstance(outcome, Done)
    found = outcome.value
    assert found.depth.shape == (120, 160)
    assert found.camera == Camera(150.0, 150.0, 79.5, 59.5, 160, 120)
    assert 0.0 < found.depth.max() < 20.0, "the sigmoid of the metric head times its greatest depth"
    assert found.bend > 0.0
    release_models()
    np.testing.assert_array_equal(observed(path, **config).value.depth, found.depth)


@pytest.mark.heavy
def test_depth_that_means_nothing_drops_the_picture_for_a_true_reason(tmp_path, weights):
    path = photo(tmp_path / "a.png", size=(120, 160))
    outcome = observed(
        path, depth="depth_anything_2", depth_weights=str(weights["metric"]), focal_px=150.0, max_depth_m=20.0
    )
    seen = perceive(outcome.value, Config(), np.random.default_rng(0), Services(tmp_path))
    assert isinstance(seen, Dropped)
    assert seen.reason in ("no_table_plane", "no_objects")
    assert seen.detail


def test_weights_of_a_relative_model_are_refused(tmp_path, weights):
    with pytest.raises(ModelAccessError, match="relative"):
        observed(
            photo(tmp_path / "a.png"), depth="depth_anything_2", depth_weights=str(weights["relative"]), focal_px=90.0
        )


def test_weights_that_could_hold_code_are_not_read(tmp_path, weights):
    torch = pytest.importorskip("torch")
    folder = tmp_path / "pickled"
    folder.mkdir()
    (folder / "config.json").write_bytes((weights["metric"] / "config.json").read_bytes())
    out = io.BytesIO()
    torch.save({}, out)
    (folder / "pytorch_model.bin").write_bytes(out.getvalue())
    with pytest.raises(ModelAccessError, match="safetensors"):
        observed(photo(tmp_path / "a.png"), depth="depth_anything_2", depth_weights=str(folder), focal_px=90.0)


@pytest.mark.heavy
def test_the_door_has_every_name_that_the_configuration_allows():
    allowed = type(Config().observe).model_fields["depth"].annotation.__args__
    assert set(DEPTH_MODELS) == set(allowed)
