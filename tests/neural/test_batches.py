"""Batches of one shape, and smaller ones where the memory does not do; torch itself says when that is."""

import numpy as np
import pytest
import torch
from PIL import Image

from schemas.config import ModelsConfig
from tableverse_factory.errors import ModelAccessError, ModelError
from tableverse_factory.neural.batches import in_batches
from tableverse_factory.neural.device import Device, device_of
from tableverse_factory.neural.identity import identity
from tableverse_factory.neural.pixels import HALF, IMAGENET, picture_on, pixel_values
from tableverse_factory.neural.weights import loaded, release

MORE_THAN_THERE_IS = 1 << 55
CPU = Device("cpu", "float32")


@pytest.fixture
def rng():
    return np.random.default_rng(8)


def test_every_call_has_the_same_size_and_results_keep_their_order():
    sizes = []

    def run(items):
        sizes.append(len(items))
        return [10 * item for item in items]

    assert in_batches(run, list(range(7)), 3) == [0, 10, 20, 30, 40, 50, 60]
    assert sizes == [3, 3, 3]
    assert in_batches(run, [], 3) == []


@pytest.mark.parametrize("fits", [1, 2, 3, 7])
def test_a_batch_that_does_not_fit_is_halved_and_nothing_is_lost(fits):
    sizes = []

    def run(items):
        sizes.append(len(items))
        if len(items) > fits:
            torch.empty(MORE_THAN_THERE_IS, dtype=torch.uint8)  # the CPU's own error
        return list(items)

    assert in_batches(run, list(range(11)), 8) == list(range(11))
    assert sizes == sorted(sizes, reverse=True)  # once halved, it stays so


def test_one_item_too_many_for_the_memory_is_a_model_error():
    def run(items):
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20 GiB")

    with pytest.raises(ModelError, match="CUDA out of memory"):
        in_batches(run, [1, 2], 2)


def test_other_errors_are_not_taken_for_a_lack_of_memory():
    def run(items):
        raise RuntimeError("mat1 and mat2 shapes cannot be multiplied")

    with pytest.raises(RuntimeError, match="shapes"):
        in_batches(run, [1, 2], 2)


def test_a_model_that_gives_too_few_answers_is_told():
    with pytest.raises(ModelError, match="1 answers to 2 items"):
        in_batches(lambda items: items[:1], [1, 2], 2)


def test_the_device_is_what_the_machine_has():
    assert device_of(ModelsConfig(device="cpu")) == CPU
    assert device_of(ModelsConfig(device="cpu", precision="bfloat16")).dtype is torch.bfloat16
    assert torch.get_num_threads() == 1
    if not torch.cuda.is_available():
        assert device_of(ModelsConfig()) == CPU
        with pytest.raises(ModelAccessError, match="sees no GPU"):
            device_of(ModelsConfig(device="cuda"))


def test_a_model_is_made_once_and_again_after_its_release():
    made = []
    assert loaded(("a",), lambda: made.append(1) or len(made)) == 1
    assert loaded(("a",), lambda: made.append(1) or len(made)) == 1
    release()
    assert loaded(("a",), lambda: made.append(1) or len(made)) == 2
    release()


def test_pictures_are_normalised_as_their_formula_says(rng):
    picture = rng.integers(0, 256, (64, 64, 3), dtype="uint8")
    for normal in (IMAGENET, HALF):
        pixels = pixel_values([picture_on(picture, CPU)], (64, 64), normal, CPU)[0].permute(1, 2, 0)
        expected = (torch.from_numpy(picture / 255.0) - torch.tensor(normal.mean)) / torch.tensor(normal.deviation)
        assert torch.allclose(pixels, expected.float(), atol=1e-5)


def test_resizing_is_as_pillow_does_it(rng):
    picture = rng.integers(0, 256, (45, 80, 3), dtype="uint8")
    for size in ((30, 40), (128, 128)):
        pixels = pixel_values([picture_on(picture, CPU)], size, HALF, CPU)[0].permute(1, 2, 0) * 127.5 + 127.5
        theirs = Image.fromarray(picture).resize(size[::-1], Image.Resampling.BILINEAR)
        difference = np.abs(pixels.numpy() - np.asarray(theirs, dtype=np.float64))
        assert difference.max() <= 1.01  # Pillow rounds between its two passes


@pytest.mark.slow
def test_pictures_are_what_transformers_own_processor_makes_of_them(rng):
    pytest.importorskip("torchvision", exc_type=ImportError)
    try:
        from transformers import Sam2ImageProcessor
    except (ImportError, RuntimeError):
        pytest.skip("torchvision does not run beside this build of torch")
    picture = rng.integers(0, 256, (480, 640, 3), dtype="uint8")
    theirs = Sam2ImageProcessor()(images=picture, return_tensors="pt")["pixel_values"]
    ours = pixel_values([picture_on(picture, CPU)], tuple(theirs.shape[-2:]), IMAGENET, CPU)
    assert float((ours - theirs).abs().max()) <= 1.01 / 255 / min(IMAGENET.deviation)


def test_other_weights_in_the_same_folder_are_another_model(tmp_path):
    (tmp_path / "model.safetensors").write_bytes(b"one")
    (tmp_path / "README.md").write_text("nothing that is read")
    one = identity(str(tmp_path))
    (tmp_path / "README.md").write_text("other words")
    assert identity(str(tmp_path)) == one
    (tmp_path / "model.safetensors").write_bytes(b"two")
    assert identity(str(tmp_path)) != one
    assert "sha256" not in identity("owner/name")
