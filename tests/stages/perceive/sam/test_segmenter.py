"""Boxes become masks: tiny SAMs of the true architecture, read from a folder by the code that reads the real ones."""

import json
import os
import shutil
import subprocess
import sys
from http.server import BaseHTTPRequestHandler

import numpy as np
import pytest

from schemas.config import Config
from schemas.geometry import TABLE_ID
from tableverse_factory.core.errors import ModelAccessError
from tableverse_factory.models.local.device import Device, import_torch
from tableverse_factory.models.local.model_daemon import close_connections
from tableverse_factory.models.local.pixels import compute_pixel_values, upload_image
from tableverse_factory.stages.perceive.base.interfaces import Candidate, DetectionResult
from tableverse_factory.stages.perceive.perceive import segment_boxes
from tableverse_factory.stages.perceive.sam.masks import BoxQuestion, compute_id_image, group_by_depth
from tableverse_factory.stages.perceive.sam.model import load_sam
from tableverse_factory.stages.perceive.sam.process import segment_in_daemon
from tableverse_factory.stages.perceive.sam.segmenter import build_question
from tableverse_factory.stages.perceive.table import find_table
from tableverse_factory.stages.perceive.table_refit import refit_table_to_mask
from tests.helpers.loopback import serving
from tests.helpers.sam_models import save_tiny
from tests.helpers.tabletop_views import Box, camera_above, look

pytestmark = pytest.mark.heavy

CPU = Device("cpu", "float32")
BOXES = np.array([[10.0, 10, 60, 60], [20, 20, 40, 40], [80, 50, 150, 100], [0, 40, 160, 120]])


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    made = {name: tmp_path_factory.mktemp(name) for name in ("sam2", "sam3")}
    return {name: (folder, save_tiny(name, folder)) for name, folder in made.items()}


@pytest.fixture(scope="module", params=["sam2", "sam3"])
def sam(request, folders):
    return load_sam(request.param, str(folders[request.param][0]), CPU)


def question(seed=0, boxes=BOXES, holders=(-1, 0, -1), size=(120, 160)):
    color = np.random.default_rng(seed).integers(0, 256, (*size, 3), dtype=np.uint8)
    return BoxQuestion(color, np.asarray(boxes, dtype=np.float64).reshape(-1, 4), np.array(holders, dtype=np.int64))


def test_scores_are_those_of_the_models_own_forward(sam, folders):
    torch = import_torch()
    asked, (_, original) = question(), next(v for v in folders.values() if type(v[1]) is type(sam._model))
    side = original.config.prompt_encoder_config.image_size
    pixels = compute_pixel_values([upload_image(asked.color, CPU)], (side, side), sam._normal, CPU)
    boxes = asked.boxes * [side / 160, side / 120, side / 160, side / 120]  # SAM's processors keep no aspect
    with torch.inference_mode():
        theirs = original.eval()(
            pixel_values=pixels, input_boxes=torch.tensor(boxes, dtype=torch.float32)[None], multimask_output=False
        ).pred_masks[:, :, 0]
        ours = sam.scores(pixels, [boxes.astype(np.float32)])[:, :4]
    assert theirs.std() > 0.1
    assert torch.equal(ours, theirs)


def test_the_same_picture_gives_the_same_ids_whoever_is_beside_it(sam):
    few = [question(k, size=(120, 160)) for k in range(3)]
    many = question(9, np.tile(BOXES, (3, 1)), (-1,) * 12, size=(100, 90))
    alone = [sam.segment([asked], 1)[0] for asked in (*few, many)]
    together = sam.segment([*few, many], 4)
    turned = sam.segment([many, *few[::-1]], 3)
    for k in range(4):
        assert np.array_equal(alone[k], together[k])
        assert np.array_equal(alone[k], [turned[3], turned[2], turned[1], turned[0]][k])
    assert any((ids > 0).any() for ids in alone)


def test_a_size_that_does_not_fit_is_tried_once(folders, monkeypatch):
    torch, sizes = import_torch(), []
    sam = load_sam("sam2", str(folders["sam2"][0]), CPU)
    embed = sam._model.get_image_embeddings

    def small_memory(pixels):
        sizes.append(len(pixels))
        if len(pixels) > 4:
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20 GiB")
        return embed(pixels)

    monkeypatch.setattr(sam._model, "get_image_embeddings", small_memory)
    for _ in range(2):
        sam.segment([question()], 8)
    assert sizes == [8, 4, 4]


def test_boxes_scale_with_the_picture(sam):
    """One colour says nothing of the size: a picture stretched with its boxes gives the masks stretched."""
    boxes = np.array([[5.0, 10, 35, 50], [40, 20, 75, 55]])
    small = BoxQuestion(np.full((60, 80, 3), 90, dtype=np.uint8), boxes, np.array([-1, -1]))
    large = BoxQuestion(np.full((240, 160, 3), 90, dtype=np.uint8), boxes * [2, 4, 2, 4], np.array([-1, -1]))
    a, b = sam.segment([small, large], 1)
    assert len(np.unique(a)) > 1
    assert np.mean(a.repeat(4, 0).repeat(2, 1) == b) > 0.93  # but for what interpolation does along borders


def test_boxes_that_are_none_have_no_pixels_and_change_nothing(sam):
    there = question(3, BOXES[:2], (-1, -1))
    nan, inf = float("nan"), float("inf")
    bad = [[500, 500, 600, 600], [-90, 0, -10, 50], [30, 30, 30, 60], [60, 60, 40, 40], [nan, 0, 9, 9], [0, 0, inf, 9]]
    both = BoxQuestion(there.color, np.vstack([there.boxes, bad]), np.full(8, -1))
    ids = sam.segment([both], 1)[0]
    assert ids.max() <= 2
    assert np.array_equal(ids, sam.segment([there], 1)[0])
    assert not sam.segment([question(3, np.zeros((0, 4)), ())], 1)[0].any()


def test_one_pixel_boxes_and_sixty_of_them(sam):
    boxes = [[x, y, x + 1, y + 1] for x in range(0, 160, 16) for y in range(0, 120, 20)]
    ids = sam.segment([question(4, boxes, (-1,) * 60)], 1)[0]
    assert ids.shape == (120, 160)
    assert 0 <= ids.min() <= ids.max() <= 60


def test_a_large_picture(folders):
    ids = load_sam("sam2", str(folders["sam2"][0]), CPU).segment([question(5, BOXES * 12.5, size=(1500, 2000))], 1)[0]
    assert ids.shape == (1500, 2000)
    assert set(np.unique(ids)) <= {-1, 0, 1, 2, 3}


def test_half_precision_keeps_boxes_exact(folders, sam):
    torch = import_torch()
    name = "sam2" if type(sam._model).__name__ == "Sam2Model" else "sam3"
    half = load_sam(name, str(folders[name][0]), Device("cpu", "bfloat16"))
    boxes = torch.tensor([[[100.0, 90, 111, 108]]])
    ours, exact = (model._model.get_prompt_embeddings(input_boxes=boxes)[0] for model in (half, sam))
    assert torch.equal(ours, exact)
    assert next(half._model.vision_encoder.parameters()).dtype is torch.bfloat16
    picture = [upload_image(question().color, CPU)]
    seen = [
        model._model.get_image_embeddings(
            compute_pixel_values(picture, (model._side, model._side), model._normal, model._device)
        )[-1].float()
        for model in (half, sam)
    ]
    assert torch.nn.functional.cosine_similarity(seen[0].flatten(), seen[1].flatten(), dim=0) > 0.99
    assert half.segment([question()], 1)[0].shape == (120, 160)


def scores(height, width, *areas, inside=4.0):
    """Score images of a square model for a picture of this size, `inside` within each area of the picture."""
    found = import_torch().full((len(areas), 64, 64), -4.0)
    for image, (x0, y0, x1, y1) in zip(found, areas, strict=True):
        image[round(y0 * 64 / height) : round(y1 * 64 / height), round(x0 * 64 / width) : round(x1 * 64 / width)] = (
            inside
        )
    return found


def test_contents_cover_their_container_and_stay_near_it():
    bowl, apple = [20.0, 20, 100, 100], [50.0, 50, 70, 70]
    asked = question(0, [bowl, apple], (-1, 0))
    # the apple's scores are lower, and spill all over the picture
    spilled = scores(120, 160, bowl, [40, 40, 160, 120])
    spilled[1] *= 0.5
    ids = compute_id_image(spilled, asked).numpy()
    assert (ids[45:95, 45:95] == 2).all()
    assert (ids[25:38, 25:95] == 1).all()
    assert not ids[:, 130:].any()  # a quarter of 80 pixels beyond the bowl
    assert (compute_id_image(spilled, question(0, [bowl, apple], (-1, -1))).numpy()[60:110, 130:150] == 2).all()


@pytest.mark.parametrize("seen", [[0.0, 0, 0, 0], [20.0, 20, 100, 24]])
def test_contents_stay_where_the_mask_of_their_container_fails(seen):
    bowl, apple = [20.0, 20, 100, 100], [50.0, 50, 70, 70]
    ids = compute_id_image(scores(120, 160, seen, [50, 50, 160, 70]), question(0, [bowl, apple], (-1, 0))).numpy()
    assert (ids[55:65, 55:110] == 2).all()
    assert not ids[:, 130:].any()  # a quarter of 80 pixels beyond the bowl's box


def test_neighbours_share_no_pixel_and_the_surer_one_has_it():
    left, right = [10.0, 10, 90, 110], [60.0, 10, 150, 110]
    both = scores(120, 160, left, right)
    both[1] *= 2
    ids = compute_id_image(both, question(0, [left, right], (-1, -1))).numpy()
    assert (ids[20:100, 62:88] == 2).all()
    assert (ids[20:100, 12:56] == 1).all()


def test_the_table_is_what_no_object_covers():
    table, cup = [0.0, 40, 160, 120], [60.0, 50, 80, 70]
    ids = compute_id_image(scores(120, 160, cup, table), question(0, [cup, table], (-1,))).numpy()
    assert (ids[53:67, 63:77] == 1).all()
    assert (ids[80:, :] == -1).all()
    assert not ids[:35].any()


def test_containers_in_containers_have_levels_and_circles_none():
    assert group_by_depth(np.array([-1, 0, 1, -1])) == [[0, 3], [1], [2]]
    assert group_by_depth(np.array([1, 0, 2, 9])) == [[0, 1, 2, 3]]
    assert group_by_depth(np.array([], dtype=np.int64)) == []


def test_a_scene_goes_through_the_door(folders):
    view = find_table(look([Box(0.0, 0.0, (0.1, 0.08, 0.12))])[0], np.random.default_rng(0))
    perceive = {"detector": "replay", "segmenter": "sam2", "segmenter_weights": str(folders["sam2"][0])}
    config = Config.model_validate({"models": {"device": "cpu"}, "perceive": perceive})
    box = Candidate("box", 1.0, (10.0, 10.0, 60.0, 60.0))
    asked = build_question(view, DetectionResult((box,), (0.0, 0.0, 300.0, 200.0)))
    assert (asked.has_table, asked.boxes.shape, asked.holders.tolist()) == (True, (2, 4), [-1])
    bowl = Candidate("bowl", 1.0, (100.0, 60.0, 220.0, 180.0))
    apple = Candidate("apple", 1.0, (120.0, 80.0, 180.0, 140.0), container=0)
    found = DetectionResult((bowl, apple), (0.0, 0.0, 300.0, 200.0))
    ids = segment_boxes(view, found, config)
    assert ids.shape == view.valid.shape
    assert set(np.unique(ids)) <= {TABLE_ID, 0, 1, 2}
    assert np.array_equal(ids, segment_boxes(view, found, config))
    nothing = segment_boxes(view, DetectionResult((), (0.0, 0.0, 300.0, 200.0)), config)
    assert not nothing.any()


def test_a_segmenter_has_time_to_load_where_no_deadline_is_set():
    perceive = {"detector": "replay", "segmenter": "sam2"}
    assert Config.model_validate({"perceive": perceive}).get_deadline("perceive") > 1000.0
    assert Config.model_validate({"perceive": {**perceive, "deadline_s": 500.0}}).get_deadline("perceive") == 500.0
    assert Config().get_deadline("perceive") == Config().run.deadline_s


def test_the_plane_is_looked_for_in_what_is_seen_as_the_table_top():
    observation, ids = look([Box(0.0, 0.0, (0.1, 0.08, 0.12))], camera_above(0.9, 0.9, 40.0), floor_z=-0.7)
    view = find_table(observation, np.random.default_rng(0))
    floor = refit_table_to_mask(view, (ids == 0) & view.valid, np.random.default_rng(0))
    assert view.plane.offset - floor.plane.offset == pytest.approx(0.7, abs=0.02)
    table = refit_table_to_mask(floor, ids == 1, np.random.default_rng(0))
    assert table.plane.offset == pytest.approx(view.plane.offset, abs=0.002)
    few = np.zeros_like(ids, dtype=bool)
    few[:10, :10] = True
    assert refit_table_to_mask(view, few, np.random.default_rng(0)) is view


def refused(weights, name="sam2"):
    with pytest.raises(ModelAccessError, match=r"perceive\.segmenter_weights") as told:
        load_sam(name, str(weights), CPU)
    assert "\n" not in str(told.value)
    return str(told.value)


def test_weights_that_are_none_are_told_in_one_line(folders, tmp_path, monkeypatch):
    assert "no such folder" in refused(tmp_path / "nowhere")
    assert "no *.safetensors" in refused(tmp_path)
    assert "holds no Sam2Model" in refused(folders["sam3"][0])
    assert "holds no Sam3TrackerModel" in refused(folders["sam2"][0], "sam3")
    (tmp_path / "config.json").write_text(json.dumps({"model_type": "depth_anything"}))
    (tmp_path / "pytorch_model.bin").write_bytes(b"\x80\x04")
    assert "not read" in refused(tmp_path)
    shutil.copy(folders["sam2"][0] / "model.safetensors", tmp_path)
    assert "holds no Sam2Model" in refused(tmp_path)
    (tmp_path / "model.safetensors").write_bytes(b"\x08\x00\x00\x00\x00\x00\x00\x00{}      ")
    assert "holds no Sam2Model" in refused(tmp_path)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)  # else its retries wait for 20 s
    assert "hub cannot be reached" in refused("nobody/nothing-here")


@pytest.mark.slow
def test_the_process_answers_with_the_bytes_of_the_model_in_this_one(folders, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    folder = str(folders["sam2"][0])
    asked = [question(k) for k in range(6)]
    alone = load_sam("sam2", folder, CPU).segment(asked, 1)

    def worker(one):
        return segment_in_daemon("sam2", folder, CPU, 4, one)

    monkeypatch.chdir(folders["sam2"][0].parent)
    first = segment_in_daemon("sam2", folders["sam2"][0].name, CPU, 4, asked[0])
    found = [worker(one) for one in asked]
    close_connections()
    assert np.array_equal(first, alone[0])
    assert all(np.array_equal(a, b) for a, b in zip(found, alone, strict=True))


class _Hub(BaseHTTPRequestHandler):
    """Answers as the hub does for gated models and for unknown ones."""

    def do_HEAD(self):
        gated = "gated" in self.path
        self.send_response(403 if gated else 401)
        self.send_header("X-Error-Code", "GatedRepo" if gated else "RepoNotFound")
        self.send_header("Content-Length", "0")
        self.end_headers()

    do_GET = do_HEAD  # noqa: N815 the name that http.server calls

    def log_message(self, *_):
        pass


@pytest.mark.slow
def test_gated_and_unknown_models_are_told_apart_without_the_token(tmp_path):
    script = """if True:
        from tableverse_factory.core.errors import ModelAccessError
        from tableverse_factory.models.local.device import Device
        from tableverse_factory.stages.perceive.sam.model import load_sam
        for weights in ("some/gated", "some/unknown"):
            try:
                load_sam("sam3", weights, Device("cpu", "float32"))
            except ModelAccessError as error:
                print(error)
    """
    with serving(_Hub) as address:
        hub = {"HF_ENDPOINT": address, "HF_HOME": str(tmp_path), "HF_TOKEN": "hf_never_shown"}
        ran = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, env={**os.environ, **hub})
    gated, unknown = ran.stdout.splitlines()
    assert "is gated: accept its licence" in gated
    assert "the hub knows no such model" in unknown
    assert "hf_never_shown" not in ran.stdout + ran.stderr
