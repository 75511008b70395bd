"""A vocabulary becomes boxes: a tiny Grounding DINO of the true architecture, held to its own processor."""

import json
import shutil

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.config import Config
from schemas.config_values import VOCABULARY
from schemas.outcome import Done
from tableverse_factory.core.config import build_config
from tableverse_factory.core.errors import ConfigError, ModelAccessError
from tableverse_factory.models.local.device import Device, import_torch
from tableverse_factory.models.local.pixels import IMAGENET, compute_pixel_values, upload_image
from tableverse_factory.models.local.weights import release_models
from tableverse_factory.models.services import Services
from tableverse_factory.run_record import collect_external_inputs
from tableverse_factory.stages.perceive.base.box_overlap import compute_iou
from tableverse_factory.stages.perceive.grounding_dino.detector import (
    PEOPLE,
    TABLE,
    detect_with_grounding_dino,
    list_labels,
    select_boxes,
)
from tableverse_factory.stages.perceive.grounding_dino.model import (
    GroundingDino,
    LabelScores,
    compute_input_size,
    group_tokens,
    load_grounding_dino,
)
from tableverse_factory.stages.perceive.perceive import perceive
from tableverse_factory.stages.perceive.table import find_table
from tests.helpers.grounding_dino_models import save_tiny_dino, save_tokenizer
from tests.helpers.sam_models import save_tiny
from tests.helpers.tabletop_views import Box, look

CPU = Device("cpu", "float32")
LABELS = ["table", "cup", "wine glass", "hand"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = tmp_path_factory.mktemp("dino")
    save_tiny_dino(made)
    return made


@pytest.fixture(scope="module")
def model(folder) -> GroundingDino:
    return load_grounding_dino(str(folder), CPU)


def picture(seed=0, size=(120, 160)):
    return np.random.default_rng(seed).integers(0, 256, (*size, 3), dtype=np.uint8)


def configured(folder, **perceive) -> Config:
    keys = {"detector": "grounding_dino", "detector_weights": str(folder), "vocabulary": ["cup", "wine glass"]}
    return build_config({"models": {"device": "cpu"}, "perceive": {**keys, **perceive}})


@given(st.integers(1, 3000), st.integers(1, 3000))
def test_the_input_has_the_size_that_the_models_processor_gives(height, width):
    from transformers.image_transforms import get_size_with_aspect_ratio

    assert compute_input_size(height, width) == get_size_with_aspect_ratio((height, width), 800, 1333)


@pytest.mark.heavy
def test_boxes_and_scores_are_those_of_the_models_own_processor(model, folder):
    """Their picture, text and boxes, as the authors' page calls them; their score is the best of all tokens."""
    from transformers import AutoTokenizer
    from transformers.models.grounding_dino.image_processing_pil_grounding_dino import GroundingDinoImageProcessorPil
    from transformers.models.grounding_dino.processing_grounding_dino import GroundingDinoProcessor

    torch = import_torch()
    color = picture(size=(800, 1000))  # of the input's size: resizing differs in the last digit
    tokenizer = AutoTokenizer.from_pretrained(folder)
    processor = GroundingDinoProcessor(GroundingDinoImageProcessorPil(), tokenizer)
    asked = processor(images=color, text=[LABELS], return_tensors="pt")
    with torch.inference_mode():
        answer = model._model(**asked)
    (theirs,) = processor.post_process_grounded_object_detection(answer, threshold=0.0, target_sizes=[(800, 1000)])
    (ours,) = model.score_labels(color, LABELS)
    words = torch.isin(asked["input_ids"][0], torch.tensor([101, 102, 1012])).logical_not()
    best = answer.logits[0][:, : len(words)][:, words].sigmoid().max(dim=1).values
    assert asked["input_ids"][0].tolist() == list(model._make_prompts(LABELS)[0].tokens)
    assert theirs["scores"].std() > 0.01
    np.testing.assert_allclose(ours.scores.max(axis=1), best.numpy(), atol=1e-5)
    np.testing.assert_allclose(ours.boxes * [1000, 800, 1000, 800], theirs["boxes"].numpy(), atol=1e-2)


@pytest.mark.heavy
def test_a_resized_picture_is_nearly_that_of_the_models_own_processor():
    from transformers.models.grounding_dino.image_processing_pil_grounding_dino import GroundingDinoImageProcessorPil

    color = picture(size=(90, 160))
    theirs = GroundingDinoImageProcessorPil()(images=color, return_tensors="pt")["pixel_values"]
    ours = compute_pixel_values([upload_image(color, CPU)], compute_input_size(90, 160), IMAGENET, CPU)
    assert ours.shape == theirs.shape
    assert (ours - theirs).abs().max() < 1.01 / 255 / 0.224  # a step of 8 bits


@pytest.mark.heavy
def test_a_label_of_two_words_has_the_better_score_of_its_words(model):
    (prompt,) = model._make_prompts(LABELS)
    per_token = import_torch().zeros((1, len(prompt.tokens)))
    for token, score in zip(np.flatnonzero(np.array(prompt.owners) == 2), (0.3, 0.7), strict=True):
        per_token[0, token] = score
    per_token[0, [0, -1]] = 0.9  # the start and the end of the text are no words
    assert group_tokens(per_token, prompt, 4).tolist() == pytest.approx(np.array([[0, 0, 0.7, 0]]))


@pytest.mark.heavy
def test_a_vocabulary_longer_than_the_model_takes_is_asked_in_parts(tmp_path):
    save_tiny_dino(tmp_path, max_text_len=8)
    model = load_grounding_dino(str(tmp_path), CPU)
    prompts = model._make_prompts(["table", "cup", "wine glass", "hand", "mug"])
    assert [sorted({*prompt.owners} - {-1}) for prompt in prompts] == [[0, 1], [2, 3], [4]]
    assert [len(prompt.tokens) for prompt in prompts] == [6, 7, 4]
    parts = model.score_labels(picture(), ["table", "cup", "wine glass", "hand", "mug"])
    assert len(parts) == len(prompts)
    asked = [np.flatnonzero(part.scores.any(axis=0)).tolist() for part in parts]
    assert sorted(k for part in asked for k in part) == [0, 1, 2, 3, 4]
    with pytest.raises(ConfigError, match=r"perceive\.vocabulary: 'cup cup cup cup cup cup cup' has more than the 6"):
        model._make_prompts(["cup cup cup cup cup cup cup"])


def scored(*rows, labels=("table", "person", "cup", "mug")):
    """Boxes with the score of one label each, as the model gives them."""
    scores = np.zeros((len(rows), len(labels)))
    for row, (_, label, score) in zip(scores, rows, strict=True):
        row[labels.index(label)] = score
    return [LabelScores(np.array([box for box, _, _ in rows], dtype=np.float64).reshape(-1, 4), scores)], labels


def selected(*rows, **perceive):
    found, labels = scored(*rows)
    config = configured("unused", **perceive).perceive
    return [(item.label, item.box) for item in select_boxes(found, labels, (100, 200), config)]


def test_of_boxes_of_one_thing_the_surest_stays():
    cup, same, other = [0.1, 0.1, 0.3, 0.5], [0.1, 0.1, 0.3, 0.52], [0.5, 0.1, 0.7, 0.5]
    rows = (same, "mug", 0.5), (cup, "cup", 0.6), (other, "cup", 0.4), (other, "mug", 0.29)
    assert selected(*rows) == [("cup", (20.0, 10.0, 60.0, 50.0)), ("cup", (100.0, 10.0, 140.0, 50.0))]
    assert len(selected(*rows, detector_overlap=1.0)) == 3
    assert len(selected(*rows, detector_score=0.55)) == 1


def test_boxes_that_are_none_are_left_out_and_others_clipped():
    nan = float("nan")
    bad = [[nan, 0, 1, 1], [0.5, 0.5, 0.5, 0.9], [0.9, 0.9, 0.8, 1.0], [1.2, 0.2, 1.5, 0.4], [0.2, 0.2, 0.21, 0.9]]
    rows = [(box, "cup", 0.9) for box in bad]
    assert selected(*rows, ([-0.2, 0.1, 0.4, 1.3], "cup", 0.8)) == [("cup", (0.0, 10.0, 80.0, 100.0))]
    assert selected() == []


@given(st.permutations(range(6)))
def test_the_order_of_the_models_boxes_does_not_matter(order):
    rows = [([k / 10, 0.1, k / 10 + 0.2, 0.6], "cup", 0.9 - 0.1 * (k % 3)) for k in range(6)]
    assert selected(*(rows[k] for k in order)) == selected(*rows)


def test_the_table_and_people_are_asked_for_once_whatever_the_vocabulary():
    assert list_labels(["cup", "table", "hand"]) == [TABLE, *PEOPLE, "cup"]


@pytest.mark.heavy
def test_a_picture_goes_through_the_detector_and_its_segmenter(folder, tmp_path):
    """Random weights name things at random; whatever they say becomes objects or is dropped, twice the same."""
    save_tiny("sam2", tmp_path)
    observation, _ = look([Box(0.0, 0.0, (0.1, 0.08, 0.12))])
    view = find_table(observation, np.random.default_rng(0))
    config = configured(folder, detector_score=0.2, detector_overlap=0.5)
    found = detect_with_grounding_dino(view, config, Services(tmp_path))
    assert found.candidates
    assert {item.label for item in found.candidates} <= {"cup", "wine glass"}
    assert all(0.2 <= item.score <= 1 for item in found.candidates)
    pairs = [(a.box, b.box) for a in found.candidates for b in found.candidates if a is not b]
    assert all(compute_iou(a, b) <= 0.5 for a, b in pairs)
    assert found.candidates == detect_with_grounding_dino(view, config, Services(tmp_path)).candidates
    config = configured(folder, detector_score=0.2, segmenter="sam2", segmenter_weights=str(tmp_path))
    one, two = (perceive(observation, config, np.random.default_rng(0), Services(tmp_path)) for _ in range(2))
    assert type(one) is type(two)
    if isinstance(one, Done):
        assert [item.label for item in one.value.objects] == [item.label for item in two.value.objects]


@pytest.mark.heavy
def test_precision_is_float32_whatever_the_configuration(folder):
    model = load_grounding_dino(str(folder), Device("cpu", "bfloat16"))
    assert next(model._model.parameters()).dtype is import_torch().float32


@pytest.mark.heavy
def test_weights_that_are_none_are_told_in_one_line(folder, tmp_path):
    def refused(weights):
        with pytest.raises(ModelAccessError, match=r"perceive\.detector_weights") as told:
            load_grounding_dino(str(weights), CPU)
        assert "\n" not in str(told.value)
        return str(told.value)

    assert "no such folder" in refused(tmp_path / "nowhere")
    assert "no *.safetensors" in refused(tmp_path)
    save_tiny("sam2", tmp_path / "sam")
    assert "holds no GroundingDinoForObjectDetection" in refused(tmp_path / "sam")
    bare = tmp_path / "bare"
    shutil.copytree(folder, bare)
    for name in ("tokenizer.json", "tokenizer_config.json"):
        (bare / name).unlink()
    assert "holds no tokenizer" in refused(bare)
    (bare / "tokenizer.json").write_text("{")
    assert "holds no tokenizer" in refused(bare)


@pytest.mark.heavy
def test_code_beside_the_weights_is_not_run(folder, tmp_path):
    """A repository may name classes of its own for `trust_remote_code`; nothing of it is imported."""
    bad = tmp_path / "bad"
    shutil.copytree(folder, bad)
    ran = tmp_path / "ran"
    (bad / "evil.py").write_text(f"from pathlib import Path\nPath({str(ran)!r}).touch()\nclass Evil: pass\n")
    for name in ("config.json", "tokenizer_config.json"):
        tree = json.loads((bad / name).read_text())
        tree["auto_map"] = {"AutoTokenizer": ["evil.Evil", "evil.Evil"], "AutoModel": "evil.Evil"}
        (bad / name).write_text(json.dumps(tree))
    load_grounding_dino(str(bad), CPU)
    assert not ran.exists()


def test_run_json_records_the_weights(folder):
    recorded = collect_external_inputs(configured(folder))
    assert len(recorded["detector"]["sha256"]) == 64
    release_models()
    with pytest.raises(ConfigError, match=r"perceive\.detector_weights: './nowhere' is not there"):
        collect_external_inputs(configured("./nowhere"))


@pytest.mark.parametrize(
    ("value", "said"),
    [
        ([], "vocabulary"),
        (["cup", "cup"], "'cup' stands twice"),
        (["Cup"], "vocabulary"),
        (["a. b"], "vocabulary"),
        (["cup "], "vocabulary"),
        (["x" * 61], "vocabulary"),
        (["c\nup"], "vocabulary"),
        (["c"] * 201, "vocabulary"),
    ],
)
def test_a_vocabulary_is_checked(value, said):
    with pytest.raises(ConfigError, match=said):
        configured("unused", vocabulary=value)


def test_the_default_vocabulary_is_asked_for_in_one_text(tmp_path):
    """By the longest split that BERT makes of our words: two pieces a word, and a full stop."""
    save_tokenizer(tmp_path)
    pieces = sum(2 * len(label.split()) + 1 for label in list_labels(VOCABULARY))
    assert pieces + 2 <= 256
