"""Pictures of scenes: what is packed, what is refused, and a policy that is trained on them and plays."""

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from schemas.curation import Relation
from tableverse_factory import TableEnv
from tableverse_factory.cli.main import app
from tableverse_factory.core.errors import InputError
from tableverse_factory.dataset.dataset import Dataset
from tableverse_factory.dataset.splits import SPLITS
from tableverse_factory.delivery.episodes.instructions import paraphrase_instruction
from tableverse_factory.delivery.episodes.pictures import DEPTH, INSTANCES, TABLE_ID, take_recorded_pictures
from tableverse_factory.delivery.episodes.selection import Episode
from tableverse_factory.evaluation.training.policy.mounts import list_intrinsics, mount_cameras
from tableverse_factory.evaluation.training.policy.pack_pictures import VIEWS as MORE
from tableverse_factory.evaluation.training.policy.pack_pictures import pack_pictures
from tableverse_factory.evaluation.training.policy.packed_pictures import (
    CAMERAS,
    DEPTH_M,
    PHRASE_WORDS,
    SIZE,
    WINDOW,
    PackedPictures,
    number_words,
)
from tableverse_factory.evaluation.training.policy.synthetic_views import take_synthetic_view
from tableverse_factory.evaluation.training.policy.views import join_views, list_wordings
from tableverse_factory.evaluation.training.policy.windows import STRIDE, crop_eye, find_window, thin_eye
from tableverse_factory.robotics.robots.registry import load_arm

torch = pytest.importorskip("torch", reason="the extra `models` is not installed")
from safetensors.torch import load_file  # noqa: E402

from tableverse_factory.evaluation.training.checkpoint import WEIGHTS  # noqa: E402
from tableverse_factory.evaluation.training.policy import picture_lesson, validate  # noqa: E402
from tableverse_factory.evaluation.training.policy.instructions import Wordings, number_instruction  # noqa: E402
from tableverse_factory.evaluation.training.policy.picture_lesson import PictureTensors  # noqa: E402
from tableverse_factory.evaluation.training.policy.picture_policy import PicturePolicy  # noqa: E402
from tableverse_factory.evaluation.training.policy.seen_points import choose_pixels, gather_points  # noqa: E402
from tableverse_factory.evaluation.training.policy.settings import PolicySettings  # noqa: E402
from tableverse_factory.evaluation.training.policy.train import (  # noqa: E402
    TrainRun,
    train_picture_policy,
    train_state_policy,
)

pytestmark = [pytest.mark.heavy, pytest.mark.usefixtures("thin")]
VIEWS, TABLES = 2, 1


@pytest.fixture(scope="module")
def pictures(dataset: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("pictures") / "pictures.npz"
    own = pack_pictures([dataset], tuple(SPLITS), views=VIEWS, tables=TABLES)
    replace(own, held_out=np.zeros_like(own.held_out)).write(path)
    return path


@pytest.mark.slow  # draws many pictures
def test_they_show_the_first_sample_and_name_its_objects(dataset: Dataset, pictures: Path) -> None:
    packed, scene = PackedPictures.read(pictures), dataset.scene("s-0")
    done = next(iter(scene.trajectories()))
    names = [camera + channel for camera in CAMERAS for channel in ("", DEPTH, INSTANCES)]
    shown = take_recorded_pictures(names, Episode(done.row, scene, done.recording()), load_arm("panda"), SIZE, [0])
    colors, depth, objects = packed.decode()
    assert colors.shape == (1 + VIEWS + TABLES, len(CAMERAS), *WINDOW, 3)
    for k, (camera, eye) in enumerate(zip(CAMERAS, mount_cameras("panda"), strict=True)):
        left, top = np.rint([eye.camera.cx, eye.camera.cy] - packed.intrinsics[0, k, 2:]).astype(int)
        color, whole, instances = (
            shown[camera + channel][0][top : top + WINDOW[0], left : left + WINDOW[1]]
            for channel in ("", DEPTH, INSTANCES)
        )
        assert np.abs(colors[0, k].astype(int) - color.astype(int)).mean() < 3.0
        assert (np.abs(depth[0, k] * DEPTH_M - whole[..., 0]) < 1e-3).mean() > 0.99
        assert (objects[0, k] == np.where(instances[..., 0] < TABLE_ID, instances[..., 0], 0)).mean() > 0.99
    rows = {row["object_id"]: row for row in dataset.objects.to_table().to_pylist() if row["scene_id"] == "s-0"}
    for row, name in enumerate((done.row["x_id"], done.row["y_id"])):
        phrase = rows[name]["distinguishing_phrases"][0]
        assert np.array_equal(packed.words[0, row, 0], number_words(phrase, packed.words.shape[3]))
    assert not np.array_equal(objects[0], objects[1])  # from another place


def test_instructions_are_those_of_tasks() -> None:
    torch.manual_seed(0)
    x, y = ("the mug", "the third tea box from the left")
    own = [torch.tensor(number_words(phrase, PHRASE_WORDS)[None].astype(np.int64)) for phrase in (x, y)]
    wordings = Wordings(torch.tensor(list_wordings().astype(np.int64)))
    said = {tuple(wordings.compose(*own)[0].tolist()) for _ in range(400)}
    asked = f"Pick up {x} and place it {Relation.ON.value} {y}"
    for wording in (asked, *paraphrase_instruction(asked)):
        assert tuple(number_instruction(wording)[0].tolist()) in said
    assert len(said) == 4 * len(Relation)
    assert number_words("Pick up the mug!", 9).tolist() == number_words("pick up THE mug", 9).tolist()


@pytest.mark.slow  # draws many pictures
def test_synthetic_tables_show_what_is_named() -> None:
    view = take_synthetic_view(3, "panda")
    again = take_synthetic_view(3, "panda")
    assert again.files == view.files
    assert np.array_equal(again.words, view.words)
    packed = join_views("panda", [(view, False)])
    objects = packed.decode()[2]
    named = np.flatnonzero(packed.words[0, :, 0, 0]) + 1
    assert len(named) >= 2
    assert np.isin(named, objects).mean() > 0.6
    assert (objects[0, 0] > 0).mean() > 0.03, "the window shows the objects, and near enough"


def test_the_policy_looks_where_training_looked(dataset: Dataset, pictures: Path) -> None:
    packed = PackedPictures.read(pictures)
    env = TableEnv(dataset.scene("s-0"), "task_000")
    env.reset(seed=0)
    taken = env.take_pictures(PicturePolicy.pictures, SIZE)
    for k, (camera, eye) in enumerate(zip(CAMERAS, mount_cameras("panda"), strict=True)):
        window = list_intrinsics(
            crop_eye(eye, *find_window(taken[camera + DEPTH][::STRIDE, ::STRIDE, 0], thin_eye(eye)))
        )
        np.testing.assert_allclose(window, packed.intrinsics[0, k], atol=1.0)


def test_what_is_lifted_lies_on_the_objects(dataset: Dataset, pictures: Path) -> None:
    shown = PictureTensors(PackedPictures.read(pictures), "cpu")
    env = TableEnv(dataset.scene("s-0"), "task_000")
    observation, _ = env.reset(seed=0)
    masks = tuple(shown.objects[:1] == k for k in (1, 2)), shown.objects[:1] > 2
    base, views = (shown.base_at[:1], shown.base_turn[:1]), torch.tensor([0])
    depth = shown.read_depth(views, False)
    points, present = gather_points(shown.compute_rays(views), depth, base, (*masks[0], masks[1]))
    assert present[0, :2].all()
    for row in range(2):
        middle = torch.tensor(observation["objects"][row, :3])
        assert (points[0, row] - middle).norm(dim=1).max() < 0.12
        assert points[0, row, :, 2].min() > -0.005


def test_pixels_are_chosen_from_the_mask_and_all_of_a_small_one() -> None:
    mask = torch.zeros(2, 50, dtype=torch.bool)
    mask[0, [3, 7, 11]] = True
    chosen, there = choose_pixels(mask, 8)
    assert set(chosen[0].tolist()) == {3, 7, 11}
    assert there.tolist() == [True, False]


def test_what_belongs_together_is_moved_together() -> None:
    torch.manual_seed(0)
    picture = torch.arange(1.0, 2 * 2 * 24 * 32 + 1).reshape(2, 2, 1, 24, 32)
    moved, mark = picture_lesson._move_views(picture, (picture % 7 == 0).float())
    assert torch.equal(mark.bool(), (moved % 7 == 0) & (moved > 0))
    assert np.isin(moved.numpy(), [0.0, *picture.flatten().tolist()]).all(), "none is mixed of two"
    assert not torch.equal(moved, picture)
    still = [(moved[k, c] == picture[k, c]).float().mean() for k in range(2) for c in range(2)]
    assert max(still) < 0.9, "each camera is moved by its own draw"


def test_a_hidden_side_leaves_the_other() -> None:
    torch.manual_seed(0)
    points = torch.rand(400, 900, 3)
    mask = torch.rand(400, 900) < 0.5
    left = picture_lesson._hide_side(mask, points)
    assert not (left & ~mask).any()
    share = left.sum(1) / mask.sum(1)
    assert float((share < 1).float().mean()) == pytest.approx(picture_lesson.HIDDEN, abs=0.08)
    assert share.min() > 0.5, "what is left of an object still tells where it is"


def test_files_of_other_content_are_refused(pictures: Path, tmp_path: Path) -> None:
    packed, path, data = PackedPictures.read(pictures), tmp_path / "bad.npz", pictures.read_bytes()
    for damaged in (b"", data[: len(data) // 2]):
        path.write_bytes(damaged)
        with pytest.raises(InputError, match="is not a file of packed pictures"):
            PackedPictures.read(path)
    arrays = {field.name: getattr(packed, field.name) for field in fields(packed)}
    for change in (
        {"ends": packed.ends + 1},
        {"words": packed.words - 1},
        {"files": packed.files[:-1]},
        {"bases": packed.bases * np.float32(np.nan)},
        {"intrinsics": packed.intrinsics[0]},
    ):
        np.savez_compressed(path, **{**arrays, **change})
        with pytest.raises(InputError, match="is not a file of packed pictures"):
            PackedPictures.read(path)


def test_damaged_pictures_are_told(pictures: Path) -> None:
    packed = PackedPictures.read(pictures)
    files = packed.files.copy()
    files[: packed.ends[0, 0, 0]] = 0
    with pytest.raises(InputError, match="a packed picture is damaged"):
        replace(packed, files=files).decode()


@pytest.mark.slow  # a training; test_train.py learns in the fast run
def test_sight_and_goals_are_learnt_and_motions_stay(
    packed: Path, pictures: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(validate, "GOALS", 4)
    monkeypatch.setattr(validate, "CHUNKS", 8)
    settings = PolicySettings(2, goals=2, flows=2, chunks=4, views=2)
    train_state_policy(settings, TrainRun(tmp_path / "state", packed, "cpu"), lambda _: None)
    state = tmp_path / "state" / WEIGHTS
    for minutes, folder in ((9.0, "whole"), (0.0, "parts"), (0.0, "parts")):
        run = TrainRun(tmp_path / folder, packed, "cpu", minutes)
        train_picture_policy(settings, run, pictures, state, lambda _: None)
    whole, parts, teacher = (load_file(tmp_path / name / WEIGHTS) for name in ("whole", "parts", "state"))
    for name, tensor in whole.items():
        assert torch.equal(tensor, parts[name]), name
        assert not name.startswith("motion.") or torch.equal(tensor, teacher[name]), name
    others = tmp_path / "others.npz"
    own = PackedPictures.read(pictures)
    replace(own, bases=own.bases + np.float32(0.01)).write(others)
    with pytest.raises(InputError, match="the pictures are not those of the demonstrations"):
        train_picture_policy(settings, run, others, state, lambda _: None)
    PicturePolicy(tmp_path / "whole" / WEIGHTS)


@pytest.mark.slow  # three trainings; tests/evaluation/training/test_train.py runs the command
def test_the_command_packs_trains_and_continues(
    dataset: Dataset, packed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(validate, "GOALS", 2)
    monkeypatch.setattr(validate, "CHUNKS", 4)
    monkeypatch.setattr("tableverse_factory.dataset.splits.SPLITS", {"train": 1.0})  # whatever its hash
    train_state_policy(PolicySettings(1, goals=2, chunks=4), TrainRun(tmp_path, packed, "cpu"), lambda _: None)

    def run(*options: str) -> str:
        sizes = ("--goals", "2", "--views", "1", "--tables", "1", "--device", "cpu")
        own = ["train", "policy", str(tmp_path / "net"), "--pictures-from", str(tmp_path / WEIGHTS), *sizes]
        answer = CliRunner().invoke(app, [*own, *options])
        return f"{answer.exit_code} {answer.output} {answer.exception}"

    done = run("--steps", "1", "--dataset", str(dataset.path))
    assert done.startswith("0 ")
    assert "1 of 1 steps" in done
    assert run("--steps", "2").startswith("0 ")
    assert len(PackedPictures.read(tmp_path / "net" / "pictures.npz").ends) == 1 + MORE + 1
    assert "no table is drawn for --tables" in run("--steps", "2")
    assert "--scenes and --motions are for a policy on states" in run("--scenes", "1")
