"""Batches of one shape, and smaller ones where the memory does not do; torch itself says when that is."""

import numpy as np
import pytest
import torch
from PIL import Image

from schemas.config import ModelsConfig
from tableverse_factory.core.errors import ModelAccessError, ModelError
from tableverse_factory.models.local.batches import is_cuda_failure, is_out_of_memory, run_in_batches
from tableverse_factory.models.local.device import Device, select_device
from tableverse_factory.models.local.fingerprint import identify_model, stat_weights
from tableverse_factory.models.local.pixels import HALF, IMAGENET, compute_pixel_values, upload_image
from tableverse_factory.models.local.weights import load_once, make_absolute, move_to_device, release_models

MORE_THAN_THERE_IS = 1 << 55
CPU = Device("cpu", "float32")


@pytest.fixture
def rng():
    return np.random.default_rng(8)


def test_every_call_has_the_same_shape_and_no_item_is_worked_on_twice():
    seen = []

    def run(items, size):
        seen.append((list(items), size))
        return [10 * item for item in items]

    assert run_in_batches(run, list(range(7)), 3) == ([0, 10, 20, 30, 40, 50, 60], 3)
    assert seen == [([0, 1, 2], 3), ([3, 4, 5], 3), ([6], 3)]
    assert run_in_batches(run, [], 3) == ([], 3)


@pytest.mark.parametrize("fits", [1, 2, 3, 7])
def test_a_batch_that_does_not_fit_is_halved_and_nothing_is_lost(fits):
    sizes = []

    def run(items, size):
        sizes.append(size)
        if size > fits:
            torch.empty(MORE_THAN_THERE_IS, dtype=torch.uint8)  # the CPU's own error
        return list(items)

    results, fitted = run_in_batches(run, list(range(11)), 8)
    assert results == list(range(11))
    assert sizes == sorted(sizes, reverse=True)  # once halved, it stays so
    assert fitted == sizes[-1] <= fits


@pytest.mark.parametrize(
    "said",
    [
        "CUDA error: out of memory\nCUDA kernel errors might be asynchronously reported",
        "CUDA error: CUBLAS_STATUS_ALLOC_FAILED when calling `cublasCreate(handle)`",
        "cuDNN error: CUDNN_STATUS_ALLOC_FAILED",
    ],
)
def test_a_lack_of_memory_is_known_however_cuda_says_it(said):
    assert is_out_of_memory(RuntimeError(said))
    assert not is_cuda_failure(RuntimeError(said))


def test_a_lost_gpu_is_no_lack_of_memory():
    lost = RuntimeError("CUDA error: an illegal memory access was encountered")
    assert is_cuda_failure(lost)
    assert not is_out_of_memory(lost)


class TooLarge(torch.nn.Module):
    def to(self, *_):
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20 GiB")


def test_a_model_that_does_not_fit_stops_the_build_and_says_so():
    with pytest.raises(ModelAccessError, match="does not fit"):
        move_to_device(TooLarge(), CPU)


def test_one_item_too_many_for_the_memory_is_a_model_error():
    def run(items, size):
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20 GiB")

    with pytest.raises(ModelError, match="CUDA out of memory"):
        run_in_batches(run, [1, 2], 2)


def test_other_errors_are_not_taken_for_a_lack_of_memory():
    def run(items, size):
        raise RuntimeError("mat1 and mat2 shapes cannot be multiplied")

    with pytest.raises(RuntimeError, match="shapes"):
        run_in_batches(run, [1, 2], 2)


def test_a_model_that_gives_too_few_answers_is_told():
    with pytest.raises(ModelError, match="1 answers to 2 items"):
        run_in_batches(lambda items, size: items[:1], [1, 2], 2)


def test_the_device_is_what_the_machine_has():
    assert select_device(ModelsConfig(device="cpu")) == CPU
    assert select_device(ModelsConfig(device="cpu", precision="bfloat16")).dtype is torch.bfloat16
    assert torch.get_num_threads() == 1
    if not torch.cuda.is_available():
        assert select_device(ModelsConfig()) == CPU
        with pytest.raises(ModelAccessError, match="sees no GPU"):
            select_device(ModelsConfig(device="cuda"))


@pytest.mark.heavy
def test_a_model_is_made_once_and_again_after_its_release():
    made = []
    assert load_once(("a",), lambda: made.append(1) or len(made)) == 1
    assert load_once(("a",), lambda: made.append(1) or len(made)) == 1
    release_models()
    assert load_once(("a",), lambda: made.append(1) or len(made)) == 2
    release_models()


def test_pictures_are_normalised_as_their_formula_says(rng):
    picture = rng.integers(0, 256, (64, 64, 3), dtype="uint8")
    for normal in (IMAGENET, HALF):
        pixels = compute_pixel_values([upload_image(picture, CPU)], (64, 64), normal, CPU)[0].permute(1, 2, 0)
        expected = (torch.from_numpy(picture / 255.0) - torch.tensor(normal.mean)) / torch.tensor(normal.deviation)
        assert torch.allclose(pixels, expected.float(), atol=1e-5)


def test_resizing_is_as_pillow_does_it(rng):
    picture = rng.integers(0, 256, (45, 80, 3), dtype="uint8")
    for size in ((30, 40), (128, 128)):
        pixels = compute_pixel_values([upload_image(picture, CPU)], size, HALF, CPU)[0].permute(1, 2, 0) * 127.5 + 127.5
        theirs = Image.fromarray(picture).resize(size[::-1], Image.Resampling.BILINEAR)
        difference = np.abs(pixels.numpy() - np.asarray(theirs, dtype=np.float64))
        assert difference.max() <= 1.01  # Pillow rounds between its two passes
        assert np.abs(pixels.numpy() - np.rint(pixels.numpy())).max() < 1e-3, "pictures have whole values"


@pytest.mark.slow
def test_pictures_are_what_transformers_own_processor_makes_of_them(rng):
    pytest.importorskip("torchvision", exc_type=ImportError)
    try:
        from transformers import Sam2ImageProcessor
    except (ImportError, RuntimeError):
        pytest.skip("torchvision does not run beside this build of torch")
    picture = rng.integers(0, 256, (480, 640, 3), dtype="uint8")
    theirs = Sam2ImageProcessor()(images=picture, return_tensors="pt")["pixel_values"]
    ours = compute_pixel_values([upload_image(picture, CPU)], tuple(theirs.shape[-2:]), IMAGENET, CPU)
    assert float((ours - theirs).abs().max()) <= 1.01 / 255 / min(IMAGENET.deviation)


def test_other_weights_in_the_same_folder_are_another_model(tmp_path):
    on_cpu = ModelsConfig(device="cpu")
    (tmp_path / "model.safetensors").write_bytes(b"one")
    (tmp_path / "README.md").write_text("nothing that is read")
    one, stamped = identify_model(str(tmp_path), on_cpu), stat_weights(str(tmp_path))
    (tmp_path / "README.md").write_text("other words")
    assert (identify_model(str(tmp_path), on_cpu), stat_weights(str(tmp_path))) == (one, stamped)
    (tmp_path / "model.safetensors").write_bytes(b"other")
    assert identify_model(str(tmp_path), on_cpu) != one
    assert stat_weights(str(tmp_path)) != stamped
    assert "sha256" not in identify_model("owner/name", on_cpu)


def test_weights_of_moge_count_whether_their_folder_or_their_file_is_named(tmp_path):
    found = []
    for content in (b"one", b"two"):
        (tmp_path / "model.pt").write_bytes(content)
        found += [identify_model(str(path), ModelsConfig(), "moge") for path in (tmp_path, tmp_path / "model.pt")]
    assert len({said["sha256"] for said in found}) == 2
    assert found[0]["sha256"] == found[1]["sha256"] != found[2]["sha256"]
    assert all("moge" in said for said in found)


def test_what_auto_means_here_is_a_part_of_the_run():
    assert identify_model("", ModelsConfig())["device"] == select_device(ModelsConfig()).kind
    assert "device" not in identify_model("", ModelsConfig(device="cpu"))  # the configuration says it


def test_a_relative_folder_is_named_in_full_and_a_name_of_the_hub_is_not(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "weights" / "sam2").mkdir(parents=True)
    assert make_absolute("weights/sam2") == make_absolute("./weights/sam2") == str(tmp_path / "weights" / "sam2")
    assert make_absolute("facebook/sam2") == "facebook/sam2"
    assert make_absolute("") == ""
