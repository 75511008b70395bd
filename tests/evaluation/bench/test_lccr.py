"""`bench lccr` on layouts of two boxes: what it counts, and what it says of files that are none."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from typer.testing import CliRunner

from schemas.config import Config, RectifyConfig
from tableverse_factory.cli.main import app
from tableverse_factory.core.errors import InputError
from tableverse_factory.evaluation.bench import ablation_picture
from tableverse_factory.evaluation.bench.free_simulation import (
    BURST_SPEED,
    ReleasedScene,
    is_stable,
    make_scene,
    measure_burst_speed,
)
from tableverse_factory.evaluation.bench.layouts import find_layouts, make_parts, read_case
from tableverse_factory.evaluation.bench.lccr import bench_lccr, summarize_scores
from tableverse_factory.evaluation.bench.rectifiers import RECTIFICATION_METHODS, STEP_M, rectify_in_steps
from tableverse_factory.evaluation.bench.support_by_force import TrueSupport, find_true_support
from tableverse_factory.geometry.mesh.meshes import from_trimesh
from tableverse_factory.geometry.relations.preserved import PreservedRelations, Relations, compare_relations
from tableverse_factory.physics.mjcf.obj_assets import encode_obj
from tableverse_factory.physics.render.views import RenderQuality
from tableverse_factory.sources.synthetic import vessels
from tableverse_factory.sources.synthetic.layout import synthesize_layouts
from tests.helpers.convex_layouts import box

Boxes = dict[str, tuple[float, float, float]]

LAYOUTS: dict[str, Boxes] = {
    "apart": {"a": (0, 0, 0.05), "b": (0.3, 0, 0.05)},
    "overlapping": {"a": (0, 0, 0.05), "b": (0.08, 0, 0.05)},
    "stacked": {"a": (0, 0, 0.05), "b": (0, 0, 0.145)},
}
"""Boxes of 10 cm: alone, overlapping by 2 cm sideways, and one sunk into the other by 5 mm."""


def write(folder: Path, layouts: dict[str, Boxes]) -> None:
    for name, boxes in layouts.items():
        poses = {key: {"position": at, "quaternion_wxyz": [1, 0, 0, 0]} for key, at in boxes.items()}
        objects = [{"id": key, "mesh": "../meshes/box.obj", "pose": pose} for key, pose in poses.items()]
        (folder / f"{name}.json").write_text(json.dumps({"objects": objects}))
        (folder / "truth" / f"{name}.json").write_text(json.dumps(poses))


def write_truth(folder: Path, name: str, boxes: Boxes) -> None:
    poses = {key: {"position": at, "quaternion_wxyz": [1, 0, 0, 0]} for key, at in boxes.items()}
    (folder / "truth" / f"{name}.json").write_text(json.dumps(poses))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "box.obj").write_bytes(encode_obj(box(0.1, 0.1, 0.1)))
    (tmp_path / "layouts" / "truth").mkdir(parents=True)
    write(tmp_path / "layouts", LAYOUTS)
    true_stack = {"a": (0, 0, 0.05), "b": (0, 0, 0.15)}
    poses = {key: {"position": at, "quaternion_wxyz": [1, 0, 0, 0]} for key, at in true_stack.items()}
    (tmp_path / "layouts" / "truth" / "stacked.json").write_text(json.dumps(poses))
    return tmp_path / "layouts"


def scene(folder: Path, boxes: Boxes) -> ReleasedScene:
    write(folder, {"scene": boxes})
    case = read_case(folder / "scene.json", None, Config(), folder.parent / "cache")
    return make_scene(case.item, case.pieces, [placed.pose for placed in case.item.objects])


def test_a_licence_beside_layouts_is_no_layout(folder: Path) -> None:
    before = find_layouts(folder, None)
    (folder / "source.json").write_text('{"licence": "CC0-1.0"}')
    assert find_layouts(folder, None) == before


@pytest.mark.heavy
def test_the_table_of_three_layouts(folder: Path, tmp_path: Path) -> None:
    config = Config()
    methods = ("Direct", "MuJoCo alone", "LCCR", "LCCR + sim")
    scores = bench_lccr(find_layouts(folder, None), folder / "truth", config, tmp_path / "cache", methods)
    direct, alone, ours, settled = (summarize_scores(scores[name], [0.0001]) for name in methods)
    on_pieces, on_meshes = "colliding by > 0.1 mm, pieces [%]", "colliding by > 0.1 mm, meshes [%]"
    assert (direct["scenes"], direct["objects"], direct["true relations"]) == (3, 6, 1)
    assert direct[on_pieces] == direct[on_meshes] == pytest.approx(200 / 3)
    assert direct["bursting scenes [%]"] == pytest.approx(100 / 3)
    assert direct["from truth, p90 [mm]"] == pytest.approx(2.5)
    assert ours[on_pieces] == ours[on_meshes] == settled[on_pieces] == settled[on_meshes] == 0.0
    assert ours["bursting scenes [%]"] == settled["bursting scenes [%]"] == 0.0
    assert ours["azimuth change, largest [°]"] == 0.0
    assert ours["support kept [%]"] == settled["support kept [%]"] == 100.0
    assert settled["scenes at rest [%]"] == 100.0
    assert settled["pairs by force"] == 1
    assert settled["pairs by force, left out"] == settled["scenes not known by force"] == 0
    assert settled["support kept, by force [%]"] == 100.0
    assert ours["support kept, by force [%]"] is settled["containment kept [%]"] is None
    assert max(scores["LCCR"].from_observed_m) == pytest.approx(0.02 + config.rectify.clearance_m, abs=1e-6)
    assert alone["from observed, p90 [mm]"] is not None
    assert alone["from observed, p90 [mm]"] > 5.0


def test_a_search_in_steps_ends_at_most_a_step_further_out(folder: Path, tmp_path: Path) -> None:
    case = read_case(folder / "overlapping.json", None, Config(), tmp_path / "cache")
    exact, stepped = (
        RECTIFICATION_METHODS[name](case, Config()).scene.poses[1].position for name in ("LCCR", "1 mm steps")
    )
    assert exact[0] <= stepped[0] <= exact[0] + STEP_M
    assert stepped[0] == pytest.approx(0.101)


def test_steps_differ_from_lccr_in_the_search_alone(folder: Path, tmp_path: Path) -> None:
    write(folder, {"free": {"a": (0, 0, 0.05), "b": (0.3, 0, 0.0505)}})
    free = read_case(folder / "free.json", None, Config(), tmp_path / "cache")
    for name in ("LCCR", "1 mm steps"):  # half a millimetre over the table is no fault
        assert RECTIFICATION_METHODS[name](free, Config()).scene.poses[1].position[2] == 0.0505
    case = read_case(folder / "overlapping.json", None, Config(), tmp_path / "cache")
    parts = make_parts(case.item.objects, case.pieces, [placed.pose for placed in case.item.objects])
    one, other = (rectify_in_steps(order, RectifyConfig()).parts for order in (parts, parts[::-1]))
    for a, b in zip(one, other[::-1], strict=True):
        np.testing.assert_array_equal(a.body.offset, b.body.offset)


@pytest.mark.heavy
def test_what_stays_and_what_bursts(folder: Path) -> None:
    step = 0.002
    standing = scene(folder, {"a": (0, 0, 0.05), "b": (0.3, 0, 0.05)})
    assert is_stable(standing, step)
    assert measure_burst_speed(standing, step) < 0.01
    falling = scene(folder, {"a": (0, 0, 0.5)})
    assert not is_stable(falling, step)
    assert measure_burst_speed(falling, step) == pytest.approx(0.981, rel=0.03)
    assert measure_burst_speed(scene(folder, LAYOUTS["overlapping"]), step) > BURST_SPEED
    assert scene(folder, {"a": (0, 0, -0.2)}).fallen == ["a"]


def test_relations_kept_are_counted_once_each() -> None:
    def relations(*carried: tuple[int, int], contained: frozenset[tuple[int, int]] = frozenset()) -> Relations:
        return Relations(frozenset(carried), frozenset(), contained)

    inside = frozenset({(3, 2)})
    truth = relations((1, 0), (2, 0), (3, 2), contained=inside)
    assert compare_relations(truth, truth) == PreservedRelations(2, 2, 1, 1)
    assert compare_relations(truth, relations((1, 0), (0, 2))) == PreservedRelations(2, 1, 1, 0)
    assert compare_relations(truth, Relations(frozenset(), frozenset({(1, 0), (2, 0)}), inside)) == PreservedRelations(
        2, 2, 1, 1
    )
    assert PreservedRelations(2, 1, 1, 0) + PreservedRelations(3, 3, 0, 0) == PreservedRelations(5, 4, 1, 0)


def test_things_that_pass_through_one_another_in_the_truth_have_no_relation(folder: Path, tmp_path: Path) -> None:
    for sunk, known in ((0.0005, 1), (0.004, 0)):
        poses = {"a": (0, 0, 0.05), "b": (0, 0, 0.15 - sunk)}
        write_truth(folder, "stacked", poses)
        case = read_case(folder / "stacked.json", folder / "truth", Config(), tmp_path / "cache")
        assert case.relations is not None
        assert len(case.relations.carried) == known


def test_support_by_force_is_unknown_where_the_truth_finds_no_rest(folder: Path, tmp_path: Path) -> None:
    config = Config.model_validate({"settle": {"max_time_s": 0.5}})  # a fall of 3 m takes longer
    write_truth(folder, "stacked", {"a": (0, 0, 0.05), "b": (0, 0, 3.0)})
    scores = bench_lccr([folder / "stacked.json"], folder / "truth", config, tmp_path / "cache", ["LCCR + sim"])
    row = summarize_scores(scores["LCCR + sim"], [])
    assert (row["scenes not known by force"], row["pairs by force"]) == (1, 0)


def test_a_pair_that_moves_until_it_rests_is_left_out_by_force(folder: Path, tmp_path: Path) -> None:
    write_truth(folder, "stacked", {"a": (0, 0, 0.05), "b": (0, 0, 0.18)})  # hangs 3 cm too high
    case = read_case(folder / "stacked.json", folder / "truth", Config(), tmp_path / "cache")
    assert find_true_support(case, Config().settle) == TrueSupport(frozenset(), 1)


def test_the_picture_shows_each_method_before_and_after_it_is_let_go(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ablation_picture, "WIDTH", 80)
    monkeypatch.setattr(ablation_picture, "HEIGHT", 60)
    monkeypatch.setattr(ablation_picture, "QUALITY", RenderQuality(shadows=False))
    methods = ("Direct", "LCCR + sim")
    ablation_picture.write_ablation(
        folder / "a.png", folder / "overlapping.json", methods, Config(), folder.parent / "cache"
    )
    picture = np.asarray(Image.open(folder / "a.png")).astype(int)
    first_row, first_column, height = slice(24, 84), slice(0, 80), 60 + 24 + 6
    second_row, second_column = slice(24 + height, 84 + height), slice(86, 166)
    assert picture.shape == (2 * height - 6, 166, 3)
    moved = np.abs(picture[first_row] - picture[second_row]).max(axis=2) > 30
    assert moved[:, first_column].mean() > 0.05
    assert not moved[:, second_column].any()


@pytest.fixture
def bowl_of_balls(folder: Path) -> Path:
    """A layout of a bowl in which one ball was seen, and three were counted."""
    bowl = vessels.make_bowl(np.random.default_rng(0)).mesh
    ball = from_trimesh(trimesh.creation.icosphere(subdivisions=1, radius=0.011))
    for name, mesh in (("bowl", bowl), ("ball", ball)):
        (folder.parent / "meshes" / f"{name}.obj").write_bytes(encode_obj(mesh))
    poses = {
        "bowl": {"position": [0, 0, 0], "quaternion_wxyz": [1, 0, 0, 0]},
        "ball": {"position": [0.01, 0, 0.03], "quaternion_wxyz": [1, 0, 0, 0]},
    }
    objects = [{"id": name, "mesh": f"../meshes/{name}.obj", "pose": pose} for name, pose in poses.items()]
    objects[1] |= {"contained_in": "bowl", "count": 3}
    (folder / "bowl.json").write_text(json.dumps({"objects": objects}))
    (folder / "truth" / "bowl.json").write_text(json.dumps(poses))
    return folder / "bowl.json"


@pytest.mark.slow  # figures of a bench
@pytest.mark.heavy
def test_every_method_starts_from_filled_containers_and_copies_count_only_where_they_can(bowl_of_balls: Path) -> None:
    config, cache = Config(), bowl_of_balls.parent.parent / "cache"
    case = read_case(bowl_of_balls, None, config, cache)
    results = {name: RECTIFICATION_METHODS[name](case, config) for name in RECTIFICATION_METHODS}
    for name, result in results.items():
        assert [body.object_id for body in result.scene.bodies] == ["bowl", "ball", "ball_2", "ball_3"], name
    scores = bench_lccr([bowl_of_balls], bowl_of_balls.parent / "truth", config, cache, ("Direct", "LCCR"))
    for score in scores.values():
        row = summarize_scores(score, [0.0001])
        assert row["objects"] == 2  # copies were seen nowhere: they have no displacement
        assert row["objects left out"] == 0
        assert row["containment kept [%]"] == 100.0
        assert row["colliding by > 0.1 mm, pieces [%]"] == 0.0


@pytest.mark.heavy
def test_counted_things_that_do_not_fit_are_counted_as_left_out(bowl_of_balls: Path) -> None:
    config = Config(rectify=RectifyConfig(max_contents=2))
    cache = bowl_of_balls.parent.parent / "cache"
    score = bench_lccr([bowl_of_balls], None, config, cache, ("Direct",))["Direct"]
    assert score.left_out == 1


def test_without_the_truth_its_rows_are_empty(folder: Path, tmp_path: Path) -> None:
    scores = bench_lccr(find_layouts(folder, 1), None, Config(), tmp_path / "cache", ("LCCR",))
    row = summarize_scores(scores["LCCR"], [0.001])
    assert row["scenes"] == 1
    assert row["from truth, median [mm]"] is row["support kept [%]"] is None


def test_bad_files_are_named(folder: Path, tmp_path: Path) -> None:
    def run(truth: Path | None, *methods: str) -> None:
        bench_lccr(find_layouts(folder, None), truth, Config(), tmp_path / "cache", methods or ("Direct",))

    with pytest.raises(InputError, match="no layout"):
        find_layouts(tmp_path / "meshes", None)
    with pytest.raises(InputError, match="unknown method 'magic'"):
        run(None, "magic")
    (folder / "truth" / "apart.json").write_text('{"a": {"position": [0, 0]}}')
    with pytest.raises(InputError, match=r"truth apart\.json"):
        run(folder / "truth")
    (folder / "truth" / "apart.json").unlink()
    with pytest.raises(InputError, match=r"truth apart\.json: No such file"):
        run(folder / "truth")
    (folder / "apart.json").write_text("{}")
    with pytest.raises(InputError, match=r"^apart\.json: bad_layout: layout: objects: is missing$"):
        run(None)


@pytest.mark.slow
def test_the_command_on_synthetic_layouts(tmp_path: Path) -> None:
    synthesize_layouts(tmp_path / "demo", 2, seed=4)
    arguments = ["bench", "lccr", str(tmp_path / "demo" / "layouts"), "--truth", str(tmp_path / "demo" / "truth")]
    environment = {"TABLEVERSE_CACHE": str(tmp_path / "cache")}
    shown = CliRunner().invoke(app, [*arguments, "--methods", "Direct,LCCR", "--most", "1"], env=environment)
    assert shown.exit_code == 0, shown.output
    assert "support kept [%]" in shown.output
    done = CliRunner().invoke(app, [*arguments, "--json"], env=environment)
    answer = json.loads(done.stdout)
    assert answer["Direct"]["scenes"] == 2
    assert answer["LCCR"]["colliding by > 0.1 mm, meshes [%]"] == 0.0
    assert answer["LCCR + sim"]["colliding by > 1 mm, pieces [%]"] == 0.0
    assert np.isfinite(answer["joint + sim"]["from truth, p90 [mm]"])
