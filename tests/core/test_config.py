"""The configuration: what is written is read back; unknown keys come with the nearest, values with what is right."""

import json
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.config import Config
from tableverse_factory.core.config import (
    MAX_FILE_BYTES,
    build_config,
    fingerprint_config,
    format_commented_yaml,
    list_keys,
    load_config,
)
from tableverse_factory.core.errors import ConfigError


@pytest.fixture
def written(tmp_path):
    def write(text: str | bytes):
        path = tmp_path / "config.yaml"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return write


def test_nothing_gives_the_defaults(written):
    assert load_config() == Config()
    assert load_config(written("")) == Config()
    assert load_config(written("run:\n  # seed: 3\n")) == Config()


def test_the_commented_file_is_the_default_configuration(written):
    text = format_commented_yaml()
    assert load_config(written(text)) == Config()
    for key in list_keys():
        assert f"\n  {key.partition('.')[2]}: " in text


def test_every_key_of_the_commented_file_can_be_read_back_changed(written):
    changed = load_config(None, ["rectify.clearance_m=0.002", "run.seed=9", "perceive.detector=replay"])
    assert load_config(written(format_commented_yaml(changed))) == changed


def test_overrides_come_after_the_file_and_the_last_one_counts(written):
    path = written("run:\n  seed: 1\n  shard_size: 3\n")
    config = load_config(path, ["run.seed=2", "run.seed=3"])
    assert (config.run.seed, config.run.shard_size) == (3, 3)


@pytest.mark.parametrize("text", ["0.001", "1e-3", "1.0e-3", " 0.001 "])
def test_numbers_are_read_as_people_write_them(text):
    assert load_config(None, [f"rectify.clearance_m={text}"]).rectify.clearance_m == 0.001


def test_numbers_are_decimal_and_a_wrong_value_of_a_list_is_told_once():
    assert load_config(None, ["run.seed=010"]).run.seed == 10
    assert load_config(None, ["rectify.clearance_m=1e-3"]).rectify.clearance_m == 1e-3
    with pytest.raises(ConfigError) as told:
        load_config(None, ["perceive.vocabulary=[Mug]"])
    assert str(told.value).count("is not allowed") == 1


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("rectify.clearence_m=1", ["rectify.clearence_m", "did you mean rectify.clearance_m?"]),
        ("rectify.epsilon_m=1", ["did you mean export.epsilon_m?"]),  # right key, wrong section
        ("rectfy.clearance_m=1", ["did you mean the section rectify?"]),
        ("rectify.zzz=1", ["rectify has ", "clearance_m"]),
        ("zzz.zzz=1", ["sections are run, observe"]),
        ("run.seed=-1", ["run.seed", "-1", "a whole number, at least 0"]),
        ("run.seed=1.5", ["run.seed", "1.5", "a whole number"]),
        ("run.seed=many", ["run.seed", "'many'", "a whole number"]),
        ("run.seed=", ["run.seed", "None"]),
        ("run.seed=yes", ["run.seed: True is not allowed; give a whole number"]),
        ("observe.max_depth_m=on", ["observe.max_depth_m: True is not allowed; give a number"]),
        ("run.seed=[1, 2]", ["run.seed", "[1, 2]"]),
        ("run.seed=[1, 2", ["run.seed", "no YAML value"]),
        ("run.seed=!!bool maybe", ["run.seed", "no YAML value"]),
        ("run.seed=!!int ''", ["run.seed", "no YAML value"]),
        ("run.seed=!!timestamp x", ["run.seed", "no YAML value"]),
        ("run.seed=!!python/object/apply:os.system [id]", ["run.seed", "no YAML value"]),
        ("rectify.clearance_m=.nan", ["rectify.clearance_m", "nan", "at least 0, at most 100"]),
        ("rectify.clearance_m=.inf", ["rectify.clearance_m", "inf"]),
        ("perceive.detector=magic", ["'magic'", "one of auto, geometric, picture, ensemble, replay"]),
        ("observe.table_distance_m=[1]", ["observe.table_distance_m: [1]", "a list of 2, each a number, more than 0"]),
        (
            "observe.table_distance_m=[a, 2]",
            ["observe.table_distance_m.0: 'a' is not allowed; give a number, more than"],
        ),
        ("observe.table_distance_m=[yes, 2]", ["observe.table_distance_m", "[True, 2]"]),
        ("rectify.clearance_m=1:30", ["rectify.clearance_m", "'1:30'"]),
        ("perceive.vocabulary=[]", ["perceive.vocabulary: []", "a list of 1 to 200, each text"]),
        ("perceive.vocabulary=[Mug]", ["perceive.vocabulary.0: 'Mug' is not allowed; give text, that matches"]),
        ("run.seed=" + "9" * 5000, ["run.seed", "an integer of thousands of digits"]),
        ("observe.table_distance_m=[4, 0.1]", ["observe.table_distance_m", "4, must be less than the second, 0.1"]),
        ("seed=3", ["section.key=value"]),
        ("run.seed", ["section.key=value"]),
        ("a.b.c=1", ["section.key=value"]),
        ("x" * 5000 + ".a=1", ["unknown key"]),
    ],
)
def test_a_wrong_override_says_the_key_the_value_and_what_is_right(override, words):
    with pytest.raises(ConfigError) as caught:
        load_config(None, [override])
    for word in words:
        assert word in str(caught.value)
    assert len(str(caught.value)) < 1000
    assert "\n" not in str(caught.value)


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("clearance_m: 1", ["did you mean rectify.clearance_m?"]),
        ("rectify: 3", ["rectify", "no section"]),
        ("- run", ["list", "at the top"]),
        ("just words", ["str", "at the top"]),
        ("run: {seed: 1, seed: 2}", ["'seed'", "twice"]),
        ("run: {seed: 1}\nrun: {seed: 2}", ["'run'", "twice"]),
        ("a: &x [1]\nb: *x", ["aliases"]),
        ("run: {seed: 1", ["not valid YAML"]),
        ("!!python/object/apply:os.system [id]", ["not valid YAML"]),
        ("1: 2", ["1"]),
        ("? [1, 2]\n: 3", ["a key is a word"]),
        (b"\xff\xfe\x00\x00", ["config.yaml"]),
        (b"\x00\x01", ["not valid YAML"]),
        ("[" * 50_000, ["not valid YAML"]),
        ("#" * (MAX_FILE_BYTES + 1), ["more than"]),
        ("run:\n  seed: -1\nexport:\n  epsilon_m: x", ["run.seed", "export.epsilon_m"]),  # both at once
    ],
)
def test_a_wrong_file_is_one_clear_error(written, text, words):
    path = written(text)
    with pytest.raises(ConfigError) as caught:
        load_config(path)
    for word in [str(path), *words]:
        assert word in str(caught.value)


def test_an_absent_file_is_named(tmp_path):
    with pytest.raises(ConfigError, match=r"no\.yaml: cannot be read"):
        load_config(tmp_path / "no.yaml")
    with pytest.raises(ConfigError, match="cannot be read"):
        load_config(tmp_path)


@pytest.mark.heavy
@pytest.mark.parametrize("key", list_keys())
def test_every_key_has_a_section_a_type_and_can_be_set_to_its_default(key):
    default = list_keys()[key]["default"]
    assert load_config(None, [f"{key}={json.dumps(default)}"]) == Config()


@pytest.mark.heavy
@given(st.integers(0, 2**40), st.floats(0.0, 100.0))
def test_equal_configurations_have_one_fingerprint_however_written(seed, clearance):
    a = load_config(None, [f"run.seed={seed}", f"rectify.clearance_m={clearance!r}"])
    b = load_config(None, [f"rectify.clearance_m={clearance:.17g}", f"run.seed={seed}"])
    assert a == b
    assert fingerprint_config(a) == fingerprint_config(b)
    other = load_config(None, [f"run.seed={seed + 1}", f"rectify.clearance_m={clearance!r}"])
    assert fingerprint_config(other) != fingerprint_config(a)


def test_a_whole_number_for_a_float_is_the_same_configuration():
    a, b = load_config(None, ["settle.max_time_s=6"]), load_config(None, ["settle.max_time_s=6.0"])
    assert fingerprint_config(a) == fingerprint_config(b)


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["curate.judge=replay"], ["needs curate.replay_dir"]),
        (["curate.judge=openai"], ["curate.model and curate.base_url"]),
        (["curate.judge=gemini", "curate.model=m"], ["needs curate.key_env"]),
        (["curate.base_url=http://judge.example/v1"], ["curate.base_url", "must begin with https"]),
        (["curate.base_url=http://127.0.0.1.example/v1"], ["must begin with https"]),
        (["curate.base_url=ftp://localhost/v1"], ["is no address"]),
        (["curate.base_url=https://me:hunter2@judge.example/v1"], ["environment variable"]),
        (["curate.base_url=https://judge.example/v1?key=hunter2"], ["no ? and no #"]),
        (["curate.base_url=https://[::1/v1"], ["is no address"]),
        (["curate.key_env=sk-hunter2"], ["never the key itself"]),
        (["curate.key_env=AIzaHunter2"], ["never the key itself"]),
        (
            ["curate.judge=openai", "curate.model=m", "curate.base_url=http://[::1]:1/v1", "run.deadline_s=100"],
            ["curate.timeout_s (240) must be less than the stage's deadline (100, of"],
        ),
    ],
)
def test_a_judge_that_cannot_be_asked_is_refused_and_nothing_secret_is_shown(overrides, words):
    with pytest.raises(ConfigError) as caught:
        load_config(None, overrides)
    for word in words:
        assert word in str(caught.value)
    assert "hunter2" not in str(caught.value).lower()


@pytest.mark.parametrize(
    "url", ["http://localhost:8000/v1", "http://127.0.0.1/v1", "http://[::1]:9/v1", "https://a.b/c"]
)
def test_addresses_on_this_machine_and_behind_https_are_taken(url):
    load_config(None, ["curate.judge=openai", "curate.model=org/judge:7b", f"curate.base_url={url}"])


def test_a_message_names_where_the_mistake_stands(tmp_path):
    """An override's own mistake is not looked for in a file, and the other way round."""
    with pytest.raises(ConfigError, match=r"^--set or override: unknown key 'trajectories\.foo'"):
        build_config({"run": {"seed": 3}}, ["trajectories.foo=1"], "run.json: ")
    with pytest.raises(ConfigError, match=r"^run\.json: unknown key 'trajectories\.foo'"):
        build_config({"trajectories": {"foo": 1}}, ["trajectories.tries=6"], "run.json: ")
    with pytest.raises(ConfigError) as both:
        build_config({"run": {"foo": 3}}, ["trajectories.tries=-1"], "run.json: ")
    assert "run.json: unknown key 'run.foo'" in str(both.value)
    assert "--set or override: trajectories.tries" in str(both.value)


@pytest.mark.parametrize(
    ("detector", "says"),
    [
        ("geometric", "gives masks, not boxes, so perceive.segmenter 'sam2' would do nothing"),
        ("auto", "not boxes where a capture has no detections.json, so perceive.segmenter 'sam2' would do nothing"),
    ],
)
def test_a_segmenter_that_would_be_given_no_boxes_is_refused(detector, says):
    overrides = [f"perceive.detector={detector}", "perceive.detector_weights=net.onnx", "perceive.segmenter=sam2"]
    with pytest.raises(ConfigError, match=re.escape(says)) as told:
        load_config(None, overrides)
    assert "to 'replay' (the boxes of detections.json), 'grounding_dino', 'openai' or 'gemini'" in str(told.value)
    load_config(None, [*overrides, "perceive.detector=replay"])
