import contextlib
import json
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from schemas.codec import decode, encode
from schemas.config import Config, CurateConfig
from schemas.curation import HINGE_CATEGORIES, Assessment
from schemas.outcome import Done, Dropped
from tableverse_factory.core.errors import AnswerInvalidError
from tableverse_factory.core.seeding import make_rng
from tableverse_factory.models.remote.json_text import MAX_ANSWER_CHARS
from tableverse_factory.models.services import Services
from tableverse_factory.physics.bodies.materials import compute_mass_bounds_kg
from tableverse_factory.stages.curate.checks import assess_answer
from tableverse_factory.stages.curate.curate import curate
from tableverse_factory.stages.curate.interfaces import Judgement
from tableverse_factory.stages.curate.judge_input import build_judge_input
from tableverse_factory.stages.curate.parse_answer import parse_judgement
from tableverse_factory.stages.curate.rules import RulesJudge
from tests.helpers.curate_scenes import kitchen
from tests.helpers.examples import scale_examples

BOWL, RED_MUG, BLUE_MUG, PLATE, LEMON, CRACKERS, BLOCK = range(7)


@pytest.fixture(scope="module")
def case():
    return build_judge_input(kitchen(), CurateConfig())


@pytest.fixture(scope="module")
def sound(case):
    """The rules' own answer as a model would have written it."""
    return json.loads(RulesJudge(CurateConfig(), Services(Path())).answer(case).model_dump_json(by_alias=True))


def task(x: object, relation: object, y: object, instruction: str | None = None) -> dict:
    return {
        "instruction": f"Pick up the thing and place it {relation} the other" if instruction is None else instruction,
        "X_id": x,
        "X_name": "the thing",
        "Y_id": y,
        "Y_name": "the other",
        "relation": relation,
        "initial_relation_satisfied": False,
    }


def verdict(case, answer: dict | str) -> Assessment:
    text = answer if isinstance(answer, str) else json.dumps(answer)
    assessment = assess_answer(
        Judgement(parse_judgement(text), text), case, CurateConfig(judge="replay", replay_dir="answers")
    )
    assert decode(encode(assessment)) == assessment
    assert [o.object_id for o in assessment.objects] == [f"obj_{i:03d}" for i in range(7)]
    assert assessment.answer_json == text
    for item, found in zip(case.items, assessment.objects, strict=True):
        low, high = compute_mass_bounds_kg(item.volume_m3, item.size)
        assert low <= found.mass_kg <= high
        assert 0 <= found.label_confidence <= 1
        assert found.hinge_category in (*HINGE_CATEGORIES, None)
    for found in assessment.tasks:
        assert found.accepted == (found.refusal == "")
        assert found.instruction.isprintable()
    return assessment


def refusals(case, sound, *tasks: dict) -> list[str]:
    return [t.refusal for t in verdict(case, {**sound, "generated_tasks": list(tasks)}).tasks]


@pytest.mark.heavy
def test_the_rules_agree_with_their_own_checks(case, sound):
    assessment = verdict(case, sound)
    assert assessment.tasks
    assert all(t.accepted for t in assessment.tasks)
    assert not any(o.from_rules or o.mass_clipped for o in assessment.objects)


@pytest.mark.parametrize(
    ("bad", "refusal"),
    [
        (task(LEMON, "in", 99), "unknown_id"),
        (task(-1, "in", BOWL), "unknown_id"),
        (task("table", "on", PLATE), "unknown_id"),
        (task(None, "on", PLATE), "unknown_id"),
        (task(10**30, "on", PLATE), "unknown_id"),
        (task(True, "on", PLATE), "unknown_id"),
        (task(LEMON, "next to", LEMON), "same_object"),
        (task(LEMON, "under", BOWL), "unknown_relation"),
        (task(LEMON, "IN", BOWL), "unknown_relation"),
        (task(LEMON, ["in"], BOWL), "unknown_relation"),
        (task(LEMON, "in", BOWL, "Put the thing in the other"), "broken_template"),
        (task(LEMON, "in", BOWL, "Pick up the thing and place it on the other"), "broken_template"),
        (task(LEMON, "in", BOWL, "Pick up the thing and place it in the other, then dance"), "broken_template"),
        (task(LEMON, "in", BOWL, ""), "broken_template"),
        (task(RED_MUG, "to the right of", BOWL), "already_holds"),
        (task(LEMON, "outside", BOWL), "already_holds"),
        (task(LEMON, "in", BLOCK), "no_container"),
        (task(LEMON, "inside", PLATE), "no_container"),
        (task(BLOCK, "on", LEMON), "no_stable_top"),
        (task(BLOCK, "on", BOWL), "no_stable_top"),
        (task(BOWL, "into", RED_MUG), "no_room"),
        (task(LEMON, "in", BOWL), ""),
        (task(str(LEMON), "into", str(BOWL)), ""),
        (task(RED_MUG, "on", PLATE), ""),
    ],
)
def test_every_broken_task_is_refused_for_its_own_reason(case, sound, bad, refusal):
    assert refusals(case, sound, bad) == [refusal]


def test_half_a_character_in_a_task_spoils_that_task_alone(case, sound):
    broken = [{**task(LEMON, "in", BOWL), key: "lemon \ud800"} for key in ("instruction", "X_name", "relation")]
    found = refusals(case, sound, *broken, task(LEMON, "in", BOWL))
    assert found == ["broken_template", "repeated", "unknown_relation", "repeated"]
    assert refusals(case, sound, broken[2], task(LEMON, "in", BOWL)) == ["unknown_relation", ""]


def test_a_triple_counts_once(case, sound):
    assert refusals(case, sound, *[task(LEMON, "in", BOWL)] * 3) == ["", "repeated", "repeated"]


def test_a_mass_of_the_wrong_order_is_clipped_and_marked(case, sound):
    physical = {**sound["physical_properties"], "0": {"mass_kg": 500.0}, "1": {"mass_kg": 1e-9}}
    objects = verdict(case, {**sound, "physical_properties": physical}).objects
    assert [o.mass_clipped for o in objects] == [True, True] + [False] * 5
    assert objects[0].mass_kg < 10


@pytest.mark.parametrize("mass", ["NaN", "Infinity", "-1", "0", '"heavy"', "null", "1e400", "[1]"])
def test_a_mass_that_is_none_is_filled_from_the_rules_and_marked(case, sound, mass):
    text = json.dumps({**sound, "physical_properties": {"0": {"mass_kg": "HERE"}}}).replace('"HERE"', mass)
    objects = verdict(case, text).objects
    assert all(o.from_rules == ("physical_properties",) for o in objects)


def test_missing_objects_are_filled_and_unknown_ones_ignored(case, sound):
    answer = {**sound, "label_confidence": {"99": 0.5, "x": 1}, "object_relabeling": {"-3": {"relabel_name": "ghost"}}}
    assessment = verdict(case, answer)
    assert all(o.from_rules == ("label_confidence", "object_relabeling") for o in assessment.objects)
    assert [o.relabel_name for o in assessment.objects][:2] == ["bowl", "mug"]


def test_a_score_cannot_contradict_its_gate(case, sound):
    for usable, codes in ((False, []), (True, ["NON_TABLETOP_OBJECT"])):
        answer = {**sound, "final_score": 10, "usability": {"usable": usable, "reason_codes": codes}}
        assessment = verdict(case, answer)
        assert not assessment.usable
        assert assessment.quality_score == 4


def test_markup_in_names_stays_text_and_stays_short(case, sound):
    evil = '<script>alert(1)</script>"/><x a="\n\x1b[31m' + "A" * 3000
    names = {"0": {"relabel_name": evil, "distinguishing_phrases": [evil] * 20}}
    found = verdict(case, {**sound, "object_relabeling": names}).objects[0]
    assert len(found.relabel_name) <= 120
    assert found.relabel_name.isprintable()
    assert len(found.distinguishing_phrases) == 1


def test_hinges_outside_the_enumeration_are_not_taken(case, sound):
    physical = {"0": {"mass_kg": 0.3, "has_hinge": True, "hinge_category": "Dishwasher"}}
    found = verdict(case, {**sound, "physical_properties": physical}).objects[0]
    assert found.has_hinge
    assert found.hinge_category is None


def test_thousands_of_tasks_cost_bounded_rows(case, sound):
    tasks = [task(i % 7, "next to", (i + 3) % 7) for i in range(1200)]
    found = verdict(case, {**sound, "generated_tasks": tasks}).tasks
    assert len(found) == 500
    assert found[-1].refusal == "too_many"


@pytest.mark.parametrize("wrap", ["```json\n{}\n```", "Here you are:\n{}\nGood luck!", "```\n{}```", "\ufeff{}"])
def test_fences_and_prose_around_the_object_do_no_harm(case, sound, wrap):
    assert verdict(case, wrap.replace("{}", json.dumps(sound))).tasks == verdict(case, sound).tasks


@pytest.mark.parametrize(
    "text",
    [
        "",
        "I am sorry, I cannot help with that.",
        "[]",
        "{",
        '{"usability": null}',
        "[" * 100_000,
        '{"a":' * 100_000 + "1" + "}" * 100_000,
        "x" * (MAX_ANSWER_CHARS + 1),
        '{"final_score": 5}',
    ],
)
def test_what_is_no_answer_is_refused_whole(text):
    with pytest.raises(AnswerInvalidError):
        parse_judgement(text)


@pytest.mark.parametrize("score", [0, 11, -5, 10**40, "NaN", None, "high"])
def test_a_score_off_the_scale_is_no_answer(sound, score):
    with pytest.raises(AnswerInvalidError):
        parse_judgement(json.dumps({**sound, "final_score": score}))


def replayed(tmp_path, data: bytes):
    (tmp_path / "scene.json").write_bytes(data)
    config = Config(curate=CurateConfig(judge="replay", replay_dir=str(tmp_path)))
    return curate(kitchen(), config, make_rng(0, "scene", "curate"), Services(tmp_path))


def test_replay_reads_what_was_recorded(tmp_path, sound):
    outcome = replayed(tmp_path, f"```json\n{json.dumps(sound)}\n```".encode())
    assert isinstance(outcome, Done)
    assert outcome.value.judge == "replay"
    assert {t.source for t in outcome.value.assessment.tasks} == {"replay"}


def test_replay_reads_the_longest_answer_that_may_be_kept(tmp_path, sound):
    answer = json.dumps(sound)
    fitting = "…" * (MAX_ANSWER_CHARS - len(answer)) + answer
    kept = replayed(tmp_path, fitting.encode()).value.assessment.answer_json
    assert kept == fitting
    assert replayed(tmp_path, ("…" + fitting).encode()).reason == "judge_answer_invalid"


@pytest.mark.parametrize("data", [b"\x00\xff\xfe garbage", b"{" * 10, b" " * (10 * MAX_ANSWER_CHARS)])
def test_a_recorded_answer_that_is_none_drops_the_scene_with_its_reason(tmp_path, data):
    outcome = replayed(tmp_path, data)
    assert isinstance(outcome, Dropped)
    assert outcome.reason == "judge_answer_invalid"
    assert len(outcome.detail) < 600


def test_a_name_that_two_objects_share_leaves_doubt(case, sound):
    def named(name: str) -> dict:
        instruction = f"Pick up the {name} and place it on the plate"
        return {**task(RED_MUG, "on", PLATE, instruction), "X_name": name, "Y_name": "plate"}

    assert refusals(case, sound, named("mug")) == ["ambiguous_name"]
    assert refusals(case, sound, named("red mug")) == [""]
    assert refusals(case, sound, named("lemon")) == ["wrong_name"]


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20) | st.just("\ud800"),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    max_leaves=5,
)


def corrupted(draw, node):
    """The answer with some of its parts exchanged for anything."""
    if draw(st.integers(0, 60)) == 0:
        return draw(JSON)
    if isinstance(node, dict):
        return {key: corrupted(draw, value) for key, value in node.items()}
    return [corrupted(draw, value) for value in node] if isinstance(node, list) else node


@pytest.mark.heavy
@settings(max_examples=scale_examples(60), deadline=None, suppress_health_check=list(HealthCheck))
@given(st.data())
def test_whatever_parts_of_an_answer_are_exchanged_it_is_a_verdict_or_none(case, sound, data):
    answer = {**sound, "generated_tasks": sound["generated_tasks"][:3]}
    text = json.dumps(corrupted(data.draw, answer))
    with contextlib.suppress(AnswerInvalidError):
        verdict(case, text)
