"""Every record travels: what comes out is what went in, equal records give equal bytes, and only records travel."""

import dataclasses
import math

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import BaseModel

from schemas import codec
from schemas.codec import RECORD_TYPES, decode, decode_stored, encode, encode_stored, normalize
from schemas.curation import AnswerOrigin, Assessment, ObjectAssessment, TaskAssessment
from schemas.detection import Composite, Container, Content, Detection, DetectionRecord, DetectionRemark, Detections
from schemas.geometry import Camera, ConvexPieces, Pose, Texture, TriangleMesh
from schemas.known_length import KnownCameraHeight, KnownDistance, KnownHeight, KnownSheet
from schemas.manifest import ImageRow, SceneKind
from schemas.objects import (
    Evidence,
    Explanation,
    FitUncertainty,
    PerceivedObject,
    PerceivedObjects,
    PlacedObject,
    PlacedObjects,
    Table,
)
from schemas.observation import Observation
from schemas.outcome import Allowance, Done, Dropped, Failed, ModelCost
from schemas.scene import Certificate, Coverage, CuratedScene, ExportedScene, RectifiedLayout, SettledScene
from schemas.trajectories import Grasps, Motion, NoMotion, Phase, Placement, Verdict
from schemas.work import (
    CommitCall,
    SandboxSetup,
    ScenePart,
    SceneResult,
    StageCall,
    StageChain,
    StageChainReport,
    StagedShard,
    StageReport,
    StageTiming,
)

HARD_TEXT = 'Ünïcode \U0001f600 \x1b[2J\n\0 \'"/><x a=" $array'


def examples(seed: int) -> dict[str, object]:
    """One instance of every record type, its numbers drawn from `seed`."""
    rng = np.random.default_rng(seed)

    def floats(*shape: int) -> np.ndarray:
        return rng.normal(size=shape) * 10.0 ** rng.integers(-9, 9)

    def pose() -> Pose:
        return Pose(floats(3), floats(4))

    def mesh(colors: bool) -> TriangleMesh:
        vertices, faces = floats(9, 3), rng.integers(0, 9, (5, 3)).astype(np.int32)
        return TriangleMesh(vertices, faces, rng.integers(0, 256, (9, 3)).astype(np.uint8) if colors else None)

    camera = Camera(*(float(x) for x in floats(4)), 8, 6)
    detections = Detections(
        detections=(Detection(label="mug", bbox_xyxy=(0, 1.5, 2, 1000), score=float(rng.random()), instance_id=3),),
        composites=(
            Composite(
                container=Container(label="bowl", bbox=(1, 2, 3, 4)),
                contents=(Content(label=HARD_TEXT, bbox=(1, 2, 3, 4), count=7),),
            ),
        ),
    )
    remark = DetectionRemark(where="detections[3]", label=HARD_TEXT, rule="person", detail="a part of one")
    record = DetectionRecord(origin=AnswerOrigin(model="m", rounds=2), answer=detections, remarks=(remark,))
    color = rng.integers(0, 256, (6, 8, 3)).astype(np.uint8)
    ids = rng.integers(-1, 5, (6, 8)).astype(np.int32)
    lengths = (
        KnownDistance(kind="distance", length_m=float(rng.uniform(0.01, 10)), pixels=((0.1, 2.0), (9.0, 3.0))),
        KnownSheet(kind="a4", pixels=((0.0, 0.0), (9.0, 0.0), (9.0, 9.0), (0.0, float(9 + rng.random())))),
        KnownHeight(kind="height", length_m=float(rng.uniform(0.01, 2)), label="mug"),
        KnownCameraHeight(kind="camera_height", length_m=float(rng.uniform(0.1, 5))),
    )
    metric = (0.015, float(rng.random()), "measured", "exif", lengths[0])
    observation = Observation("a-1", color, floats(6, 8).astype(np.float32), camera, detections, ids, (), *metric)
    perceived = PerceivedObject("obj_000", 2, HARD_TEXT, 0.5, floats(4, 3), color.reshape(-1, 3)[:4], "obj_001", 3)
    table = Table(floats(2), floats(2), float(floats()), (1, 2, 3), 0.001)
    texture = Texture(color, floats(2, 3, 2))
    placed = PlacedObject("obj_000", "mug", 0.25, mesh(True), 1.25, pose(), None, 2, 0.004, "carved")
    evidence = Evidence(rng.bytes(33), rng.bytes(1), (1, 500), camera, pose())
    explanation = Explanation(90, float(rng.random()), (("obj_000", 60, 0.125),))
    left_out = (("obj_009", HARD_TEXT),)
    layout = PlacedObjects(
        "a-1", table, (placed, placed), evidence, "geometric", left_out, record, explanation=explanation
    )
    coverage = Coverage(0.5, (float(rng.random()), None))
    pieces = ConvexPieces((mesh(False), mesh(False)), 1.0625, 1e-300, "coacd", "filled")
    rectified = RectifiedLayout("a-1", layout, (pieces, pieces), (pose(), pose()), (0, 1), math.inf)
    settled = SettledScene("a-1", rectified, (pose(), pose()), 0.5)
    judged = ObjectAssessment(object_id="obj_000", relabel_name="mug", label_confidence=0.1, mass_kg=0.3)
    task = TaskAssessment(
        task_id="t", instruction="x", x_id="a", y_id="b", relation="on", source="rules", accepted=False, refusal="r"
    )
    assessment = Assessment(
        usable=True, quality_score=7, criterion_scores={"b": 1, "a": 2}, objects=(judged,), tasks=(task,)
    )
    certificate = Certificate(0.001, *(float(x) for x in floats(6)), (("obj_000", 0.1),), ("x",), (), True, False)
    exported = ExportedScene(
        "a-1",
        (("assets/a.obj", rng.bytes(100)), ("scene.xml", b"")),
        certificate,
        {"n_objects": 2, "usable": True, "drift_m": float(floats()), "reason": None},
        ({"object_id": "obj_000", "distinguishing_phrases": ("a", HARD_TEXT)},),
        (),
    )
    row = ImageRow(scene_id="a-1", kind=SceneKind.CAPTURE, uri="/x", name=HARD_TEXT)
    part = ScenePart("0123.parts", 7, 100, 1000)
    result = SceneResult(row, "failed", "place", "", "crash", HARD_TEXT, 2, (StageTiming("place", 0.1, 0.2),), part)
    found = (
        Allowance(int(rng.integers(99)), None),
        assessment,
        camera,
        certificate,
        pieces,
        CuratedScene("a-1", settled, "rules", assessment, coverage),
        coverage,
        explanation,
        record,
        detections,
        Done(layout),
        Dropped("not_at_rest", HARD_TEXT),
        evidence,
        exported,
        texture,
        Failed("crash", ""),
        FitUncertainty(float(rng.random()), None, 0, 0.5),
        Grasps(floats(4, 3, 3), floats(4, 3), floats(4), floats(4)),
        Motion(0.02, floats(5, 7), floats(5, 7), floats(5), np.array([0, 0, 1, 2, 5], dtype=np.int32)),
        Placement(pose(), 0.004),
        NoMotion(Phase.GRASP.value, "blocked", f"{rng.random()} {HARD_TEXT}"),
        Verdict(False, "grasp", "slipped", HARD_TEXT, *(float(x) for x in floats(2))),
        row,
        observation,
        perceived,
        PerceivedObjects("a-1", observation, pose(), table, ids, (perceived,), "replay"),
        placed,
        layout,
        pose(),
        rectified,
        SandboxSetup("m:a", "{}", "/c", 2, 100, "/r"),
        result,
        settled,
        ModelCost(2, 1800, 80, float(rng.random())),
        part,
        StageCall(1.5, "0123"),
        StageChain(row, 3, 1, (StageCall(1.5, "0123"),), "a-1.cut.0", Allowance(5)),
        StageChainReport((StageReport(None, 1, 0.1, 0.2),), part),
        CommitCall(3, ("a-1", "b"), ("trajectories",), "0123"),
        StagedShard("0123", 100, ("trajectories",), ("a-1",)),
        StageReport(Dropped("x"), 1, 0.1, 0.2, "trace", ModelCost(1), ModelCost(2)),
        StageTiming("place", 0.1, 0.2),
        table,
        mesh(True),
        *lengths,
    )
    return {type(record).__name__: record for record in found}


def assert_equal(a: object, b: object) -> None:
    """Structural equality, exact to the bit; dataclasses with arrays have no `==`."""
    assert type(a) is type(b)
    if dataclasses.is_dataclass(a):
        for field in dataclasses.fields(a):
            assert_equal(getattr(a, field.name), getattr(b, field.name))
    elif isinstance(a, np.ndarray):
        assert a.dtype == b.dtype
        assert a.shape == b.shape
        assert a.tobytes() == b.tobytes()
    elif isinstance(a, tuple):
        assert len(a) == len(b)
        for left, right in zip(a, b, strict=True):
            assert_equal(left, right)
    elif isinstance(a, dict):
        assert list(a) == list(b)
        for key in a:
            assert_equal(a[key], b[key])
    else:
        assert a == b or (a != a and b != b)


def test_no_record_type_is_forgotten():
    assert sorted(examples(0)) == sorted(RECORD_TYPES)


@pytest.mark.parametrize("name", sorted(RECORD_TYPES))
def test_records_come_back(name):
    for seed in range(5):
        record = examples(seed)[name]
        data = encode(record)
        back = decode(data)
        assert_equal(back, record)
        assert encode(back) == data
        assert encode(examples(seed)[name]) == data, "equal records give equal bytes"
        assert encode(examples(seed + 100)[name]) != data or not _has_numbers(record)


def _has_numbers(record: object) -> bool:
    """Whether `examples` draws anything for this type."""
    return type(record) not in (
        CommitCall,
        ScenePart,
        StagedShard,
        StageChain,
        StageChainReport,
        Dropped,
        Failed,
        ImageRow,
        SandboxSetup,
        SceneResult,
        StageCall,
        StageReport,
    ) and not (isinstance(record, Assessment | StageTiming))


@pytest.mark.parametrize("name", sorted(RECORD_TYPES))
def test_a_normal_record_is_what_its_message_gives_back(name):
    """What the next stage gets is the same from the stage before it and from a checkpoint."""
    record = examples(0)[name]
    assert_equal(normalize(record), decode(encode(record)))
    assert encode(normalize(record)) == encode(record)


def test_normal_arrays_have_the_layout_of_those_that_come_back():
    grid = np.arange(24.0).reshape(4, 6)
    messy = {"t": grid.T, "f": np.asfortranarray(grid), "s": grid[::2, ::3], "n": np.float32(0.5), "l": [grid[0], 1]}
    normal, back = normalize(messy), decode(encode(messy))
    assert_equal(normal, back)
    for key in "tfs":
        assert normal[key].flags.c_contiguous
        assert not normal[key].flags.writeable
        assert normal[key].strides == back[key].strides
    assert normalize(normal) is normal, "nothing is made twice"
    with pytest.raises(TypeError, match="does not travel"):
        normalize(np.array(["text"]))
    with pytest.raises(TypeError, match="no record type"):
        normalize(object())


def test_a_stored_record_refers_to_its_parent_and_holds_each_array_once():
    mesh = TriangleMesh(np.random.default_rng(0).random((200, 3)), np.zeros((100, 3), dtype=np.int32))
    settled = examples(0)["SettledScene"]
    (thing, *_), layout = settled.rectified.placed.objects, settled.rectified.placed
    layout = dataclasses.replace(layout, objects=(dataclasses.replace(thing, mesh=mesh),))
    rectified = dataclasses.replace(settled.rectified, placed=layout)
    settled = dataclasses.replace(settled, rectified=rectified)
    first, parent = encode_stored("a.rectify.0", rectified)
    second, child = encode_stored("a.settle.1", settled, parent)
    assert len(second) < len(encode(settled)) / 2
    assert child.blobs.keys() == parent.blobs.keys()
    moved = dataclasses.replace(rectified, placed=dataclasses.replace(layout, perception="again"))
    third, _ = encode_stored("a.other.2", moved, parent)
    assert len(third) < len(first), "arrays that the parent holds are not repeated"

    stored = {"a.rectify.0": first, "a.settle.1": second, "a.other.2": third}

    def read(name):
        return decode_stored(name, stored[name], read)

    assert_equal(read("a.settle.1").record, settled)
    assert_equal(read("a.other.2").record, moved)
    del stored["a.rectify.0"]
    with pytest.raises(ValueError, match="not a message"):
        read("a.settle.1")


def test_arrays_come_back_read_only():
    back = decode(encode(examples(0)["TriangleMesh"]))
    with pytest.raises(ValueError, match="read-only"):
        back.vertices[0, 0] = 1.0


scalars = st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.binary()
trees = st.recursive(
    scalars,
    lambda inner: st.lists(inner, max_size=4).map(tuple) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=20,
)


@pytest.mark.heavy
@given(trees)
def test_any_tree_comes_back(tree):
    """Also a mapping whose keys look like the codec's own marks."""
    assert_equal(decode(encode(tree)), tree)
    assert_equal(decode(encode({"$array": tree, "$record": tree})), {"$array": tree, "$record": tree})


@given(
    st.sampled_from(["<f8", ">f4", "<i4", ">u2", "|u1", "|b1", "<c16"]),
    st.lists(st.integers(0, 3), max_size=4).map(tuple),
    st.integers(0, 2**32 - 1),
)
def test_any_array_comes_back(dtype, shape, seed):
    raw = np.random.default_rng(seed).integers(0, 2, shape).astype(dtype)
    for array in (raw, raw.T, np.asfortranarray(raw)):
        assert_equal(decode(encode(array)), np.ascontiguousarray(array).reshape(array.shape))


@pytest.mark.parametrize(
    "stranger",
    [
        object(),
        {1, 2},
        np.array([object()], dtype=object),
        np.zeros(2, dtype=[("a", "f8")]),
        pa.table({"a": [1]}),
        type("Pose", (), {})(),
        type("Model", (BaseModel,), {})(),
        print,
    ],
    ids=["object", "set", "objects", "structured", "table", "namesake", "model", "function"],
)
def test_what_is_no_record_does_not_travel(stranger):
    for value in (stranger, (stranger,), {"a": stranger}, Done(stranger)):
        with pytest.raises(TypeError):
            encode(value)


def message(tree: str, *blobs: bytes) -> bytes:
    """A message that nobody's `encode` wrote."""
    schema = codec._SCHEMA
    batch = pa.record_batch(
        [pa.array([tree.encode()], pa.large_binary()), pa.array([list(blobs)], schema.field(1).type)], schema
    )
    return bytes(batch.serialize())


@pytest.mark.parametrize(
    "forged",
    [
        b"",
        b"not arrow",
        message("{"),
        message('{"$record":"os.system","fields":["true"]}'),
        message('{"$record":"Pose","fields":[]}'),
        message('{"$record":"Pose","fields":[1,2,3,4,5]}'),
        message('{"$record":["Pose"],"fields":[]}'),
        message('{"$model":"ImageRow","json":"{}"}'),
        message('{"$model":"Pose","json":"{}"}'),
        message('{"$record":"ImageRow","fields":["a"]}'),
        message('{"$array":0,"dtype":"|O","shape":[1]}', b"\0" * 8),
        message('{"$array":0,"dtype":"<f8","shape":[1000000000000]}', b"\0" * 8),
        message('{"$array":7,"dtype":"<f8","shape":[1]}', b"\0" * 8),
        message('{"$array":"0","dtype":"<f8","shape":[1]}', b"\0" * 8),
        message('{"$bytes":9}'),
        message('{"$dict":[[1]]}'),
        message('{"$dict":[[{"$dict":[]},1]]}'),
        message("[" * 100_000),
        message('{"unheard":1}'),
    ],
)
def test_a_forged_message_is_a_value_error(forged):
    with pytest.raises(ValueError, match=r"\S"):
        decode(forged)


@pytest.mark.heavy
@settings(max_examples=300, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_a_damaged_message_decodes_or_is_a_value_error(seed):
    rng = np.random.default_rng(seed)
    data = bytearray(encode(examples(0)["PlacedObjects"]))
    for position in rng.integers(0, len(data), 4):
        data[position] = rng.integers(0, 256)
    cut = int(rng.integers(0, len(data))) if rng.random() < 0.3 else len(data)
    try:
        decode(bytes(data[:cut]))
    except ValueError:
        return
