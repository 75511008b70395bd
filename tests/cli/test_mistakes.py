"""The mistakes of a newcomer: a line or two, which name what was given and say what to type; never a traceback."""

import json
import shutil
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tableverse_factory.core.errors import InputError
from tableverse_factory.core.storage.untrusted import parse_json, read_bytes
from tests.helpers.small_dataset import write_small_dataset


@pytest.fixture(scope="module")
def home(tmp_path_factory) -> Path:
    """A folder as a newcomer has it: a dataset, a note, an empty folder, a misspelt configuration, a manifest."""
    home = tmp_path_factory.mktemp("home")
    write_small_dataset(home / "out")
    (home / "note.txt").write_text("hi")
    (home / "empty").mkdir()
    (home / "photos").mkdir()
    (home / "photos" / "readme.md").write_text("none yet")
    (home / "bad.yaml").write_text("run: {sed: 1}\n")
    pq.write_table(pa.table({"name": ["a"]}), home / "other.parquet")
    rows = [{"scene_id": "s", "kind": "capture", "uri": "/x", "rejected": "unreadable_color"}]
    pq.write_table(pa.Table.from_pylist(rows), home / "images.parquet")
    return home


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("line", "code", "says"),
    [
        ("biuld images.parquet out", 2, ["'biuld'", "'build'", "tableverse --help"]),
        ("--versoin", 2, ["--versoin", "--version"]),
        ("build", 2, ["MANIFEST is missing", "tableverse build images.parquet out"]),
        ("build images.parquet", 2, ["OUT is missing", "tableverse build images.parquet out"]),
        ("build images.parquet out more", 2, ["more", "tableverse build images.parquet out"]),
        ("build images.parquet new --woker 3", 2, ["--woker", "did you mean --workers?"]),
        ("build images.parquet new --workers 0", 2, ["--workers", "'0'", "1"]),
        ("build images.parquet new --workers many", 2, ["--workers", "'many'", "integer"]),
        ("build images.parquet new --executor Ray2", 2, ["'Ray2'", "'local', 'ray'"]),
        ("build nowhere.parquet new", 1, ["nowhere.parquet", "tableverse manifest FOLDER --out nowhere.parquet"]),
        ("build photos new", 1, ["photos is a folder", "tableverse manifest photos --out images.parquet"]),
        ("build out new", 1, ["out is a dataset", "tableverse build MANIFEST out"]),
        ("build note.txt new", 1, ["note.txt is no Parquet file", "tableverse manifest"]),
        ("build other.parquet new", 1, ["other.parquet lacks the columns", "tableverse manifest"]),
        ("build images.parquet note.txt/out", 1, ["note.txt is a file", "another OUT"]),
        ("build images.parquet new --config nowhere.yaml", 1, ["nowhere.yaml"]),
        ("build images.parquet new --config bad.yaml", 1, ["bad.yaml", "did you mean run.seed?"]),
        ("build images.parquet new --set run.sed=1", 1, ["--set", "did you mean run.seed?"]),
        ("build images.parquet new --set seed=1", 1, ["'seed=1'", "section.key=value"]),
        ("build images.parquet new --from settel", 1, ["'settel'", "did you mean settle?"]),
        ("build images.parquet new --stages trajectories", 1, ["'trajectories'", "+trajectories"]),
        ("build images.parquet new --shards a-b", 1, ["'a-b'", "3-7,9"]),
        ("build images.parquet new --address host", 1, ["host"]),
        ("bench completion --error-mm nan", 2, ["--error-mm: 'nan' is not a number"]),
        ("bench completion --error-mm 51", 2, ["--error-mm: '51' should be less than or equal to 50"]),
        ("manifest nowhere --out m.parquet", 1, ["nowhere: no such file or folder"]),
        ("manifest photos --out m.parquet", 1, ["photos", "color.png"]),
        ("manifest  --out m.parquet", 1, ["an empty path"]),
        ("bench twin photos --pictures note.txt", 2, ["--pictures", "note.txt", "file"]),
        ("bench completion --view 1", 2, ["--view: '1'", "200,25"]),
        ("manifest note.txt --out m.parquet", 1, ["note.txt", ".png"]),
        ("manifest photos", 2, ["--out", "is missing", "tableverse manifest photos/ captures/ --out images.parquet"]),
        ("synth note.txt", 1, ["note.txt", "new or empty folder"]),
        ("synth out", 1, ["out", "new or empty folder"]),
        ("synth s3://bucket/captures", 2, ["s3:", "no folder of this machine"]),
        ("init note.txt", 1, ["note.txt"]),
        ("status nowhere", 1, ["nowhere: there is no such folder", "OUT of `tableverse build`"]),
        ("status note.txt", 1, ["note.txt is a file", "OUT of `tableverse build`"]),
        ("status out --jsno", 2, ["did you mean --json?"]),
        ("status out --watch --json", 2, ["--watch", "--json"]),
        ("query empty", 1, ["empty", "OUT of `tableverse build`"]),
        ("query out/scenes", 1, ["out/scenes", "did you mean", "out?"]),
        ("query .", 1, ["did you mean out?"]),
        ("query out --table scene", 2, ["'scene'", "'scenes'"]),
        ("query out --columns scene_idd", 1, ["'scene_idd'", "did you mean scene_id?"]),
        ("query out --columns mass", 1, ["did you mean mass_kg of another table? give --table objects"]),
        ("query out --columns zzzz", 1, ["columns are scene_id, kind, ", ", … (all: --columns all --limit 1)"]),
        ("query out --limit -3", 2, ["--limit", "'-3'"]),
        ("extract out new --scene c-33", 1, ["'c-33'", "c-3"]),
        ("extract out new --scene nosuch", 1, ["'nosuch'", "tableverse query out"]),
        ("extract out photos --scene c-3", 1, ["photos", "new or an empty folder"]),
        ("extract out new --scene c-3 --format ubs", 2, ["'ubs'", "'usd'"]),
        ("extract out new --scene c-3 --texture marbel-3", 1, ["'marbel-3'", "did you mean marble?"]),
        ("extract out", 2, ["DEST is missing", "tableverse extract out "]),
        ("verify empty", 1, ["empty", "OUT of `tableverse build`"]),
        ("verify out --robot arm.xml", 2, ["--robot", "--trajectories"]),
        ("report nowhere", 1, ["nowhere", "OUT of `tableverse build`"]),
        ("report out --dest note.txt", 1, ["note.txt"]),
        ("stats note.txt", 1, ["note.txt", "OUT of `tableverse build`"]),
        ("stats out --out s3://bucket/figures", 2, ["no folder of this machine"]),
        ("report out --dest s3://bucket/gallery", 2, ["no folder of this machine"]),
        ("evaluate tables photos --out s3://bucket/tables", 2, ["no folder of this machine"]),
        ("export out out/public", 1, ["out/public", "out"]),
        ("stats out --out out/figures", 1, ["out/figures"]),
        ("verify out --root photos", 2, ["--root", "MJCF"]),
        ("export empty new", 1, ["empty holds no build"]),
        ("export out out", 1, ["out is the dataset"]),
        ("export lerobto out new", 2, ["'lerobto'", "'lerobot'"]),
        ("estimate out", 2, ["--scenes is missing", "tableverse estimate out --scenes"]),
        ("train policy note.txt --dataset out", 2, ["note.txt is a file", "give a new folder, or one whose training"]),
        ("train picture note.txt", 2, ["DIR: note.txt is a file"]),
        ("train picture note.txt/net --scenes 1", 2, ["note.txt is a file"]),
        ("textures make marbel-3 --out t.png", 1, ["'marbel-3'", "did you mean marble?"]),
        ("config --config note.txt", 1, ["note.txt", "sections with keys"]),
        ("bench lcr layouts", 2, ["'lcr'", "'lccr'"]),
        ("bench factory --sizes 10,many", 1, ["--sizes 'many'", "1000000"]),
        ("bench factory --sizes 2000000", 1, ["--sizes '2000000'", "1000000"]),
        ("bench factory --payload 7XB", 1, ["--payload '7XB'", "7MB"]),
        ("bench factory --payload 2GB", 1, ["--payload '2GB'", "up to 1GB"]),
        ("bench soak out", 1, ["out", "new or empty folder"]),
        ("bench soak new --kill-every 1", 2, ["--kill-every", "5"]),
        ("evaluate collisions nowhere", 1, ["nowhere: no such file or folder"]),
    ],
)
def test_a_mistake_is_answered_with_what_to_type(tableverse, home, monkeypatch, line, code, says):
    monkeypatch.chdir(home)
    before = sorted(home.rglob("*"))
    answer = tableverse(*line.split(" "))
    assert answer.code == code, answer.err
    assert answer.out == "", "what is wrong is said on stderr"
    said = answer.err.splitlines()
    assert said[0].startswith("error: ")
    assert 1 <= len(said) <= 3
    assert max(map(len, said)) < 400
    for words in says:
        assert words in answer.err
    assert "Traceback" not in answer.err
    assert sorted(home.rglob("*")) == before, "nothing is left behind"


def test_a_file_that_is_no_configuration_is_answered_once(tableverse, tmp_path):
    wrong = tmp_path / "wrong.yaml"
    wrong.write_text("".join(f"word{number}: {number}\n" for number in range(9)) + "run: {sed: 1}\n")
    said = tableverse("config", "--config", wrong).err
    assert said.count("sections are") == 1
    assert "did you mean run.seed?" in said
    assert said.count(str(wrong)) == 1
    assert "'word0'" in said
    assert "and 5 more" in said


def test_what_is_not_there_is_said_in_plain_words_and_its_path_once(tmp_path):
    with pytest.raises(InputError) as told:
        read_bytes(str(tmp_path / "gone.json"), 100, "bad_layout")
    assert str(told.value) == f"{str(tmp_path / 'gone.json')!r} cannot be read: no such file or directory"
    with pytest.raises(InputError) as told:
        parse_json(b'{"a":\n x}', "a.json", "bad_layout")
    assert str(told.value) == "a.json is no JSON: expecting value, line 2, column 2"
    with pytest.raises(InputError, match=r"^a\.json is no JSON: it is no text in UTF-8, from byte 1$"):
        parse_json(b'"\xff"', "a.json", "bad_layout")


def test_another_configuration_names_the_key_and_both_values(tableverse, home, tmp_path):
    build = ("build", home / "images.parquet", tmp_path / "out", "--executor", "local")
    assert tableverse(*build).code == 0
    answer = tableverse(*build, "--set", "run.seed=7")
    assert answer.code == 1
    for words in ("run.seed was 0 and is now 7", "another OUT"):
        assert words in answer.err


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("out out", "DEST out is the dataset, out: give a folder apart from it"),
        ("out ./more/../out", "DEST more/../out is the dataset"),
        ("out out/cousins", "DEST out/cousins lies within the dataset, out: "),
        ("out link", "DEST link, a link to "),
        ("out link/cousins", "DEST link/cousins lies within the dataset"),
        ("out inside", "/out/scenes, lies within the dataset"),
        ("out out/away", "lies within the dataset"),
        ("out .", "DEST . holds the dataset"),
        ("link out", "DEST out is the dataset, link: "),
        ("out round", "round: a link that leads nowhere; give another folder"),
    ],
)
def test_cousins_go_nowhere_into_the_dataset_of_their_parents(tableverse, home, tmp_path, monkeypatch, line, says):
    shutil.copytree(home / "out", tmp_path / "out")
    for name, target in (("link", "out"), ("inside", "out/scenes"), ("out/away", "../else"), ("round", "round")):
        (tmp_path / name).symlink_to(target)
    for name in ("else", "more"):
        (tmp_path / name).mkdir()
    monkeypatch.chdir(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    answer = tableverse("cousins", *line.split(" "))
    assert answer.code == 1
    assert says in answer.err
    assert sorted(tmp_path.rglob("*")) == before


def test_a_robot_is_held_against_the_dataset(tableverse, home, tmp_path):
    """One that has no effect, and one that is missing, are said before anything is replayed."""
    out = tmp_path / "out"
    shutil.copytree(home / "out", out)
    run = json.loads((out / "run.json").read_text())
    for made_with, robot, words in (
        ("panda", "other.xml", "was made with panda, so leave --robot out"),
        ("my/arm.xml", None, "its arm came from a file, my/arm.xml: give that file with --robot"),
    ):
        run["config"] = {"trajectories": {"robot": made_with}}
        (out / "run.json").write_text(json.dumps(run))
        given = () if robot is None else ("--robot", robot)
        for command in (("verify", out, "--trajectories"), ("export", "robomimic", out, tmp_path / "new.hdf5")):
            answer = tableverse(*command, *given)
            assert answer.code == 1
            assert answer.err.startswith("error: ")
            assert words in answer.err
            assert answer.err.splitlines()[1].startswith("help: docs/troubleshooting.md#")
