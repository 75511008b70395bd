"""Text from outside (layouts, detections, manifest rows): wrong is refused with its place, labels are cleaned."""

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from schemas.detection import MAX_DETECTIONS, Detections
from schemas.error_text import describe_validation_error
from schemas.layout import MAX_OBJECTS, Layout
from schemas.manifest import ImageRow
from schemas.tables import MANIFEST


def entry(**changes):
    pose = {"position": [0.1, 0.0, 0.04], "quaternion_wxyz": [1, 0, 0, 0]}
    return {"id": "obj_000", "label": "mug", "mesh": "meshes/mug.obj", "pose": pose, **changes}


def layout(*objects):
    return {"scene_id": "s", "frame": "table", "objects": list(objects)}


def posed(**changes):
    return entry(pose={**entry()["pose"], **changes})


def test_a_layout_reads_as_the_document_says():
    found = Layout.model_validate_json(json.dumps(layout(entry(), entry(id="b", contained_in="obj_000"))))
    assert found.objects[0].scale == 1.0
    assert found.objects[1].contained_in == "obj_000"
    assert Layout.model_validate_json(found.model_dump_json()) == found


@pytest.mark.parametrize(
    ("bad", "where"),
    [
        (layout(), "objects"),
        ({"objects": None}, "objects"),
        ([], "Layout"),
        (layout(*(entry(id=f"o{i}") for i in range(MAX_OBJECTS + 1))), "objects"),
        (layout(entry(), entry()), "repeat"),
        (layout(entry(id="../../x")), "objects.0.id"),
        (layout(entry(id="")), "objects.0.id"),
        (layout(entry(id="x" * 10_000)), "objects.0.id"),
        (layout(entry(contained_in="obj_000")), "contained_in"),
        (layout(entry(contained_in="nobody")), "contained_in"),
        (layout(entry(scale=0)), "objects.0.scale"),
        (layout(entry(scale=-1)), "objects.0.scale"),
        (layout(entry(scale=float("nan"))), "objects.0.scale"),
        (layout(entry(scale=float("inf"))), "objects.0.scale"),
        (layout(entry(mesh="")), "objects.0.mesh"),
        (layout(entry(mesh=None)), "objects.0.mesh"),
        (layout(posed(position=[0, 0])), "position"),
        (layout(posed(position=[0, 0, float("nan")])), "position"),
        (layout(posed(position=[0, 0, 1e9])), "position"),
        (layout(posed(position="origin")), "position"),
        (layout(posed(quaternion_wxyz=[0, 0, 0, 0])), "quaternion_wxyz"),
        (layout(posed(quaternion_wxyz=[1, 0, 0])), "quaternion_wxyz"),
        (layout(posed(yaw=1.0)), "unknown key 'yaw'; keys are position, quaternion_wxyz"),
        (layout(entry(scal=2.0)), "unknown key 'scal'; did you mean scale"),
        (layout(entry(Label="mug")), "unknown key 'Label'; did you mean label"),
        (layout(entry(pose={"postion": [0, 0, 0], "quaternion_wxyz": [1, 0, 0, 0]})), "did you mean position"),
        (layout(entry(pose={"position": [0, 0, 0], "quaternion": [1, 0, 0, 0]})), "did you mean quaternion_wxyz"),
        ({**layout(entry()), "object": []}, "unknown key 'object'; did you mean objects"),
        ({**layout(entry()), "\x1b[2J" * 99: 1}, r"unknown key '\\x1b"),
        ({**layout(entry()), "frame": "camera"}, "table frame"),
        ({**layout(entry()), "frame": "table: y up, table plane y=0, metres"}, "table frame"),
        ({**layout(entry()), "frame": "table: y up, z up, table plane z=0, metres"}, "table frame"),
        ({**layout(entry()), "frame": "TABLE : Y-UP"}, "table frame"),
        ({**layout(entry()), "frame": "table (y up)"}, "table frame"),
        ({**layout(entry()), "frame": "table: y axis is up"}, "table frame"),
        ({**layout(entry()), "frame": "table: up = y"}, "table frame"),
        ({**layout(entry()), "frame": "table: y points up"}, "table frame"),
        ({**layout(entry()), "frame": "table: y = up"}, "table frame"),
        ({**layout(entry()), "frame": "table: -z up, metres"}, "table frame"),
        ({**layout(entry()), "frame": "table: z down"}, "table frame"),
        ({**layout(entry()), "frame": "table: z up, table plane z = 0.75, metres"}, "table frame"),
        ({**layout(entry()), "frame": "table: z up, mm"}, "table frame"),
        ({**layout(entry()), "frame": "table: z up, units: cm"}, "table frame"),
        ({**layout(entry()), "frame": "table: z up (in millimeters)"}, "table frame"),
        ({**layout(entry()), "frame": "table: z up, camera frame"}, "table frame"),
        ({**layout(entry()), "frame": "world: z up, metres"}, "table frame"),
        ({**layout(entry()), "frame": "tableau"}, "table frame"),
        ({**layout(entry()), "frame": "table: z up, table plane z=0, millimetres"}, "table frame"),
        (layout(entry(id="table")), "'table' cannot be used"),
        (layout(entry(id="World")), "'World' cannot be used"),
        (layout(entry(id="mug"), entry(id="mug_piece_00")), "'mug_piece_00' cannot be used"),
        (layout(entry(id="mug"), entry(id="Mug")), "'Mug' cannot be used"),
        (layout(entry(id="a", contained_in="b"), entry(id="b", contained_in="a")), "circle: a in b in a"),
        (layout(entry(contained_in="obj_000")), "circle: obj_000 in obj_000"),
    ],
)
def test_a_wrong_layout_is_refused_with_its_place(bad, where):
    with pytest.raises(ValidationError, match=where):
        Layout.model_validate(bad)


@pytest.mark.parametrize(
    "frame",
    [
        "",
        "table",
        "table:",
        "table_frame",
        "table: z up",
        "table: metres, z up",
        "TABLE:Z-UP; meters",
        "table: z up, table plane z=0, metres",
        "table : z up , table plane z = 0.0 , metres",
        "Table: z up,  metres, table plane z=0, from my rig",
        "table: z up, table plane z=0, metres (origin at the centre)",
        "table: z up, scanned to 0.5 mm by a depth camera (y up before)",
        "table: x right, y away, z up",
    ],
)
def test_the_table_frame_may_be_said_in_few_words_or_many(frame):
    assert Layout.model_validate({**layout(entry(count=3)), "frame": frame}).objects[0].count == 3


def test_a_chain_that_leads_into_a_circle_names_the_circle_alone():
    objects = [entry(id=name, contained_in=holder) for name, holder in ("ab", "bc", "cd", "db")]
    with pytest.raises(ValidationError, match="circle: b in c in d in b;"):
        Layout.model_validate(layout(*objects))


@pytest.mark.parametrize(
    ("bad", "said"),
    [
        ([], "give keys and values"),
        ({"objects": {}}, "objects: give a list"),
        ({"objects": []}, "objects: give at least 1"),
        (layout({"id": "a"}), "objects.0.mesh: is missing"),
        (layout(entry(pose=[0, 0, 0])), "objects.0.pose: give keys and values"),
    ],
)
def test_what_is_wrong_is_said_in_the_words_of_the_file(bad, said):
    with pytest.raises(ValidationError) as caught:
        Layout.model_validate(bad)
    assert describe_validation_error(caught.value).startswith(said)


def test_a_container_may_hold_a_container_but_ids_stay_in_the_scene():
    Layout.model_validate(layout(entry(), entry(id="b", contained_in="obj_000"), entry(id="c", contained_in="b")))


@given(st.text(max_size=300))
def test_labels_are_cleaned_on_entry(text):
    label = Layout.model_validate(layout(entry(label=text))).objects[0].label
    assert label.isprintable()
    assert 1 <= len(label) <= 120
    found = Detections.model_validate({"detections": [{"label": text, "bbox_xyxy": [0, 0, 1, 1]}]})
    assert found.detections[0].label == label


def box(**changes):
    return {"label": "mug", "bbox_xyxy": [412, 300, 498, 441], "score": 0.97, **changes}


def test_detections_read_as_the_document_says():
    answer = {
        "detections": [box(instance_id=1)],
        "composites": [
            {
                "type": "container_fill",
                "container": {"label": "bowl", "bbox": [100, 420, 330, 610], "instance_id": 2},
                "contents": [{"label": "orange", "bbox": [160, 400, 240, 480], "count": 3}],
            }
        ],
    }
    found = Detections.model_validate_json(json.dumps(answer))
    assert found.detections[0].instance_id == 1
    assert found.composites[0].contents[0].count == 3
    assert Detections.model_validate_json(found.model_dump_json()) == found
    assert Detections.model_validate({}) == Detections()


@pytest.mark.parametrize(
    ("bad", "where"),
    [
        ({"detections": [box(bbox_xyxy=[0, 0, 1])]}, "bbox_xyxy"),
        ({"detections": [box(bbox_xyxy=[0, 0, 1, 1001])]}, "bbox_xyxy"),
        ({"detections": [box(bbox_xyxy=[-1, 0, 1, 1])]}, "bbox_xyxy"),
        ({"detections": [box(bbox_xyxy=[float("nan"), 0, 1, 1])]}, "bbox_xyxy"),
        ({"detections": [box(score=1.5)]}, "score"),
        ({"detections": [box(label=["mug"])]}, "label"),
        ({"detections": [box(label="x" * 10_000)]}, "label"),
        ({"detections": [box()] * (MAX_DETECTIONS + 1)}, "detections"),
        ({"detections": {"label": "mug"}}, "detections"),
        ({"composites": [{"type": "stack", "container": {"label": "a", "bbox": [0, 0, 1, 1]}}]}, "type"),
        ({"composites": [{"contents": []}]}, "container"),
        ("a mug", "Detections"),
    ],
)
def test_wrong_detections_are_refused_with_their_place(bad, where):
    with pytest.raises(ValidationError, match=where):
        Detections.model_validate(bad)


def test_the_manifest_table_holds_a_row_and_nothing_else():
    assert MANIFEST.names == list(ImageRow.model_fields)


@pytest.mark.parametrize(
    "bad",
    [
        {"scene_id": "../x"},
        {"kind": "video"},
        {"uri": "x" * 5000},
        {"extra": 1},
        {"uri": None},
    ],
)
def test_a_wrong_manifest_row_is_refused(bad):
    good = {"scene_id": "a", "kind": "image", "uri": "/a.png"}
    assert ImageRow.model_validate(good).rejected == ""
    with pytest.raises(ValidationError):
        ImageRow.model_validate({**good, **bad})
