"""Trajectories in the gallery: a film, a plot and a verdict each, found by the filter, safe against their text."""

from dataclasses import replace
from pathlib import Path

import pytest
from PIL import Image

from tableverse_factory.dataset.dataset import open_dataset
from tableverse_factory.robotics.execution.arrays import encode_recording
from tableverse_factory.robotics.execution.perturbations import PERTURBATIONS
from tableverse_factory.viz.gallery import formatting
from tableverse_factory.viz.gallery.gallery import write_gallery
from tableverse_factory.viz.gallery.motions import choose_filmed_tasks, write_motions
from tests.helpers.gallery_dataset import HOSTILE
from tests.helpers.recorded_dataset import recording, trajectory_row, write_recorded_dataset
from tests.viz.gallery.test_gallery import Page, digest, index_of

pytestmark = pytest.mark.heavy


@pytest.fixture(scope="module")
def out(tmp_path_factory) -> Path:
    good, short = encode_recording(recording()), encode_recording(recording(7))
    hostile = {"instruction": HOSTILE, "detail": HOSTILE, "reason": HOSTILE, "failed_phase": HOSTILE}
    unplanned = {"failed_phase": None, "reason": "no_grasp", "detail": "0 of 2000 candidates", "arrays": None}
    scenes = {
        "both": [
            (trajectory_row("both", "task_000", True), good),
            (trajectory_row("both", "task_001", False, **hostile), short),
            (trajectory_row("both", "task_002", False, **unplanned), None),
            (trajectory_row("both", "task_003", False), b"damaged"),
        ],
        "none": [],
    }
    return write_recorded_dataset(tmp_path_factory.mktemp("motions") / "out", scenes)


@pytest.fixture(scope="module")
def gallery(out) -> Path:
    return write_gallery(open_dataset(out), out.with_name("gallery"), renders=1).parent


@pytest.fixture(scope="module")
def scene(gallery) -> Page:
    return Page(gallery / "scenes" / "both.html")


def test_a_film_is_of_the_whole_recording(gallery):
    with Image.open(gallery / "pictures" / "both-task_000.webp") as film:
        assert (film.size, film.n_frames) == ((320, 240), 21)
        first = film.convert("RGB").tobytes()
        film.seek(20)
        assert film.convert("RGB").tobytes() != first
    assert (gallery / "pictures" / "both-task_000.webp").stat().st_size < 120_000
    with Image.open(gallery / "pictures" / "both-task_000.jpg") as still:
        assert still.size == (320, 240)


def test_films_are_linked_with_a_still_that_says_what_it_shows(gallery, scene):
    films = [link["href"] for link in scene.all("a") if link.get("class") == "film"]
    assert films == ["../pictures/both-task_000.webp", "../pictures/both-task_001.webp"]
    assert all((gallery / "scenes" / film).resolve().is_file() for film in films)
    stills = [image for image in scene.all("img") if "task_" in image["src"]]
    assert len(stills) == 2
    assert stills[0]["alt"] == "Film of the robot: Put the green block on the red block."


def test_verdicts_are_told_with_phase_and_reason(scene):
    text = " ".join(scene.text.split())
    assert "1 of 4 succeed in simulation" in text
    assert "Succeeds" in text
    assert "half friction" in text
    assert "Fails: no grasp" in text
    assert "0 of 2000 candidates" in text
    assert "Fails at grasp: not grasped" in text
    assert "No film: scene both" in text or "No film: trajectories/task_003.npz" in text


def test_no_text_of_a_trajectory_becomes_markup(scene):
    assert [script["src"].rpartition("/")[2] for script in scene.all("script")] == ["gallery.js"]
    assert "style" not in {name for _, attributes in scene.tags for name in attributes}
    assert HOSTILE in scene.text
    assert scene.text.count("alert(1)") >= 2
    ids = [attributes["id"] for _, attributes in scene.tags if "id" in attributes]
    assert len(set(ids)) == len(ids)


def test_plots_are_part_of_the_page(scene):
    assert len(scene.all("svg")) == 2
    assert len(scene.all("polyline")) == 2 * 9


def test_the_filter_knows_how_many_motions_succeed(gallery):
    assert {e[0]: (e[10], e[11]) for e in index_of(gallery)["done"]} == {"both": (1, 4), "none": (0, 0)}
    index = Page(gallery / "index.html")
    assert "motions" in [select["name"] for select in index.all("select")]
    assert "1 of 4" in " ".join(index.text.split())


def test_a_scene_without_trajectories_has_no_section_of_them(gallery):
    assert "Trajectories" not in Page(gallery / "scenes" / "none.html").text


def test_films_can_be_left_out(out, tmp_path):
    motions = write_motions(open_dataset(out).scene("both"), tmp_path, films=0)
    assert [bool(motion.plot) for motion in motions] == [True, True, False, False]
    assert not any(motion.film for motion in motions)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow  # a gallery more
def test_a_page_without_films_does_not_speak_of_them(out, tmp_path, scene):
    page = write_gallery(open_dataset(out), tmp_path / "gallery", renders=1, films=0).parent / "scenes" / "both.html"
    assert "Press one to play it." in " ".join(scene.text.split())
    assert "1 of 4 succeed in simulation." in " ".join(Page(page).text.split())
    assert "Films" not in Page(page).text


def test_changes_are_told_in_words():
    assert set(formatting.PERTURBATION_NAMES) == set(PERTURBATIONS)
    assert formatting.format_perturbations(list(PERTURBATIONS)) == "half and double friction, ±30 % mass"
    assert formatting.format_perturbations(["mass_plus_30", "<new>"]) == "+30 % mass, <new>"
    assert (
        formatting.format_perturbations([]) == formatting.format_perturbations(None) == "no change of friction or mass"
    )


def test_films_are_of_different_relations_and_outcomes_first():
    kinds = [("on", True), ("on", True), ("in", True), ("on", False), ("on", True), ("in", True)]
    rows = [{"task_id": f"{k}", "relation": r, "success": s, "arrays": "x"} for k, (r, s) in enumerate(kinds)]
    rows.append({"task_id": "without", "relation": "left of", "success": False, "arrays": None})
    assert choose_filmed_tasks(rows, 3) == {"0", "2", "3"}
    assert choose_filmed_tasks(rows, 4) == {"0", "1", "2", "3"}
    assert choose_filmed_tasks(rows, 99) == {f"{k}" for k in range(6)}
    assert choose_filmed_tasks(rows, 0) == frozenset()


def test_the_id_of_a_task_that_is_no_file_name_is_refused(tmp_path):
    rows = [
        (trajectory_row("a-1", "../evil", True, arrays="trajectories/task_000.npz"), encode_recording(recording(3)))
    ]
    source = write_recorded_dataset(tmp_path / "out", {"a-1": rows})
    with pytest.raises(ValueError, match="not usable"):
        write_motions(open_dataset(source).scene("a-1"), tmp_path, films=9)
    assert not list(tmp_path.rglob("*evil*"))


def test_an_arm_that_is_not_there_costs_its_film(tmp_path):
    rows = [(trajectory_row("a-1", "task_000", True), encode_recording(replace(recording(5), robot="unheard-of")))]
    source = write_recorded_dataset(tmp_path / "out", {"a-1": rows})
    (motion,) = write_motions(open_dataset(source).scene("a-1"), tmp_path, films=9)
    assert (motion.film, motion.plot) == ("", None)
    assert "unheard-of" in motion.problem


@pytest.mark.slow
@pytest.mark.usefixtures("full_quality")
def test_the_same_bytes_again(out, tmp_path):
    drawn = [write_gallery(open_dataset(out), tmp_path / str(jobs), jobs=jobs, renders=1).parent for jobs in (1, 2)]
    assert digest(drawn[0]) == digest(drawn[1])
