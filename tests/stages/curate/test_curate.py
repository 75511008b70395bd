import numpy as np
import pytest

from schemas.codec import decode, encode
from schemas.config import Config, CurateConfig
from schemas.curation import Assessment
from schemas.outcome import Done, Dropped
from schemas.scene import SettledScene
from tableverse_factory.core.seeding import make_rng
from tableverse_factory.models.services import Services
from tableverse_factory.stages.curate.curate import curate
from tableverse_factory.stages.curate.judge_input import build_judge_input
from tableverse_factory.stages.curate.usability import is_partitioned
from tests.helpers.curate_scenes import BLUE, RED, Thing, ball, box, cylinder, kitchen, settled, vessel


def judged(scene: SettledScene, tmp_path, **options) -> Assessment:
    config = Config(curate=CurateConfig(**options))
    outcome = curate(scene, config, make_rng(0, scene.scene_id, "curate"), Services(tmp_path))
    assert isinstance(outcome, Done), outcome
    assert decode(encode(outcome.value)).assessment == outcome.value.assessment
    return outcome.value.assessment


@pytest.fixture(scope="module")
def assessment(tmp_path_factory) -> Assessment:
    """Of the kitchen."""
    return judged(kitchen(), tmp_path_factory.mktemp("kitchen"))


@pytest.mark.heavy
def test_same_scene_same_bytes(assessment, tmp_path):
    assert judged(kitchen(), tmp_path) == assessment


def test_a_kitchen_scene_is_usable_and_worth_its_points(assessment):
    assert assessment.usable
    assert assessment.quality_score >= 7
    assert set(assessment.criterion_scores) == {
        "category_diversity",
        "geometric_plausibility",
        "graspability",
        "layout_clarity",
    }
    assert [o.object_id for o in assessment.objects] == [f"obj_{i:03d}" for i in range(7)]


@pytest.mark.parametrize("turn", [0.0, 0.7, 1.6])
@pytest.mark.parametrize(("gap", "partitioned"), [(0.19, False), (0.21, True)])
def test_partition_compares_the_band_with_the_larger_cluster(gap, partitioned, turn):
    """Two clusters, 0.2 m and 0.1 m long; the band between them decides, however the scene lies."""
    row = [(0.08, -0.16), (0.08, -0.04), (0.10, gap + 0.05)]
    c, s = np.cos(turn), np.sin(turn)
    things = [Thing("box", box(dx, 0.08, 0.08), c * x, s * x, yaw=turn) for dx, x in row]
    case = build_judge_input(settled(things, (2, 2)), CurateConfig())
    assert is_partitioned(case.bodies) is partitioned


def test_an_even_spread_is_no_partition():
    things = [Thing("cup", cylinder(0.025, 0.08), 0.17 * i, 0.17 * j) for i in range(3) for j in range(3)]
    assert not is_partitioned(build_judge_input(settled(things, (2, 2)), CurateConfig()).bodies)


def test_three_far_clusters_are_a_partition_although_no_single_cut_shows_it():
    things = [Thing("cup", cylinder(0.03, 0.08), 0.5 * i + dx) for i in range(3) for dx in (-0.04, 0.04)]
    assert is_partitioned(build_judge_input(settled(things, (2, 2)), CurateConfig()).bodies)


def test_an_unusable_scene_is_kept_and_capped(tmp_path):
    scene = kitchen()
    things = [
        Thing(o.label, o.mesh, *pose.position[:2])
        for o, pose in zip(scene.rectified.placed.objects, scene.poses, strict=True)
    ]
    assessment = judged(settled([*things, Thing("live cat", box(0.1, 0.2, 0.15), 0.1, 0.3)]), tmp_path)
    assert not assessment.usable
    assert assessment.reason_codes == ("NON_TABLETOP_OBJECT",)
    assert assessment.quality_score <= 4
    assert len(assessment.objects) == 8


@pytest.mark.parametrize("label", ["toy car", "cat figurine", "dog bowl", "hand soap", "hot dog", "mug with a cat"])
def test_stand_ins_belong_on_a_table(label, tmp_path):
    assert judged(settled([Thing(label, box(0.08, 0.08, 0.08))]), tmp_path).usable


@pytest.mark.heavy
def test_fewer_than_five_objects_cost_points(tmp_path):
    scores = []
    for count in range(1, 7):
        things = [
            Thing(n, cylinder(0.03, 0.08), 0.1 * i)
            for i, n in enumerate(("mug", "can", "jar", "cup", "apple", "box")[:count])
        ]
        scores.append(judged(settled(things), tmp_path).quality_score)
    assert scores == sorted(scores)
    assert scores[0] <= 3
    assert scores[3] < scores[4]


def test_an_impossible_size_is_a_severe_error_and_a_generic_label_is_not(tmp_path):
    things = [Thing("mug", box(0.9, 0.3, 0.3)), Thing("object", ball(0.03), 0.6, 0.2)]
    assessment = judged(settled(things, (1, 1)), tmp_path)
    assert assessment.severe_label_error
    assert [o.label_error for o in assessment.objects] == [True, False]
    assert assessment.objects[0].corrected_label == "box"
    assert assessment.objects[1].label_confidence < 0.7


@pytest.mark.heavy
def test_masses_are_sensible(assessment):
    masses = {o.relabel_name: o.mass_kg for o in assessment.objects}
    assert 0.05 < masses["mug"] < 0.6
    assert 0.03 < masses["lemon"] < 0.2
    assert not any(o.mass_clipped for o in assessment.objects)


def test_an_unnamed_bowl_weighs_what_a_bowl_does_and_an_unnamed_box_is_not_solid(tmp_path):
    things = [Thing(name, vessel(0.06, 0.05), 0.2 * i) for i, name in enumerate(("bowl", "object"))]
    things.append(Thing("object", box(0.1, 0.1, 0.1), -0.3))
    named, unnamed, filled = judged(settled(things, (1, 1)), tmp_path).objects
    assert unnamed.mass_kg == named.mass_kg
    assert filled.mass_kg == pytest.approx(0.37, abs=0.02)


def test_hinges_come_from_the_category(tmp_path):
    labels = ["laptop", "scissors", "trash can", "soup can", "wooden box"]
    things = [Thing(label, box(0.2, 0.1, 0.05), 0.25 * i - 0.5) for i, label in enumerate(labels)]
    objects = judged(settled(things, (1, 1)), tmp_path).objects
    assert [o.hinge_category for o in objects] == ["Laptop", "Scissors", "TrashCan", None, None]
    assert [o.has_hinge for o in objects] == [True, True, True, False, False]


@pytest.mark.heavy
def test_names_never_carry_an_index(tmp_path):
    things = [Thing(f"bowl_{i}", vessel(0.06, 0.05), 0.2 * i) for i in range(3)]
    for item in judged(settled(things, (1, 1)), tmp_path).objects:
        assert item.relabel_name == "bowl"
        assert not any(c.isdigit() for phrase in item.distinguishing_phrases for c in phrase)


def test_phrases_name_one_object_each(assessment):
    phrases = [o.distinguishing_phrases for o in assessment.objects]
    flat = [phrase for own in phrases for phrase in own]
    assert all(phrases)
    assert len(set(flat)) == len(flat)
    assert "the red mug" in phrases[1]
    assert "the blue mug" in phrases[2]
    assert "the mug nearest to the camera" in phrases[1]  # its y is smaller
    assert "the mug" not in flat
    assert "the plate" in phrases[3]


def test_a_phrase_is_not_given_where_it_would_be_true_of_two(tmp_path):
    """Two red mugs side by side at the same depth: only left and right tell them apart; three: the middle one too."""
    things = [Thing("mug", vessel(0.035, 0.09, color=RED), x) for x in (-0.2, 0.0, 0.2)]
    things.append(Thing("cup", vessel(0.035, 0.09, color=BLUE), 0.0, 0.2))
    phrases = [o.distinguishing_phrases for o in judged(settled(things), tmp_path).objects]
    assert phrases[0][0] == "the leftmost mug"
    assert "the second red mug from the left" in phrases[1]
    assert phrases[2][0] == "the rightmost mug"
    assert "the cup" not in phrases[3]  # a mug is a cup to many
    assert "the blue cup" in phrases[3]


@pytest.mark.heavy
def test_containment_makes_a_phrase(tmp_path):
    things = [
        Thing("bowl", vessel(0.08, 0.06)),
        Thing("lemon", ball(0.028), 0.0, 0.0, 0.005),
        Thing("lemon", ball(0.028), 0.0, 0.2),
    ]
    objects = judged(settled(things), tmp_path).objects
    assert "the lemon in the bowl" in objects[1].distinguishing_phrases
    assert "the lemon in the bowl" not in objects[2].distinguishing_phrases


def test_what_is_inside_can_be_asked_for_outside(tmp_path):
    things = [Thing("bowl", vessel(0.08, 0.05)), Thing("lemon", ball(0.028), 0.0, 0.0, 0.005)]
    tasks = judged(settled(things), tmp_path).tasks
    assert any(t.relation == "outside" and t.x_id == "obj_001" and t.y_id == "obj_000" for t in tasks)
    assert not any(t.relation in ("in", "into", "inside") for t in tasks)
    assert not any(t.x_id == "obj_000" for t in tasks)  # it carries the lemon


def test_tasks_use_many_relations_and_stay_within_the_limit(tmp_path):
    tasks = judged(kitchen(), tmp_path, max_tasks=12).tasks
    assert len(tasks) == 12
    assert all(t.accepted for t in tasks)
    assert len({t.relation for t in tasks}) >= 6
    assert {"in", "on"} <= {t.relation for t in tasks}
    assert judged(kitchen(), tmp_path, max_tasks=0).tasks == ()


def test_nothing_is_asked_of_what_no_gripper_holds(tmp_path):
    things = [
        Thing("cracker box", box(0.2, 0.2, 0.2)),
        Thing("lemon", ball(0.028), 0.3),
        Thing("brick", box(0.2, 0.1, 0.06), -0.3),
    ]
    objects, tasks = (lambda a: (a.objects, a.tasks))(judged(settled(things), tmp_path, max_grasp_mass_kg=0.1))
    assert [o.graspable for o in objects] == [False, True, False]
    assert {t.x_id for t in tasks} == {"obj_001"}


@pytest.mark.heavy
def test_a_single_object_has_no_task(tmp_path):
    assert judged(settled([Thing("mug", vessel(0.04, 0.09))]), tmp_path).tasks == ()


def test_a_flat_sheet_and_a_needle_do_not_break_the_judge(tmp_path):
    flat = box(0.2, 0.2, 0.0004)
    needle = box(0.0008, 0.0008, 0.2)
    things = [Thing("paper", flat), Thing("needle", needle, 0.3), Thing("mug", vessel(0.04, 0.09), -0.3)]
    assert len(judged(settled(things), tmp_path).objects) == 3


def test_a_missing_recorded_answer_drops_with_its_reason(tmp_path):
    config = Config(curate=CurateConfig(judge="replay", replay_dir=str(tmp_path)))
    outcome = curate(kitchen(), config, make_rng(0, "s", "curate"), Services(tmp_path))
    assert isinstance(outcome, Dropped)
    assert outcome.reason == "judge_answer_missing"
