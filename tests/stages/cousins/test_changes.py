"""Changes keep things on the table, out of one another and on what carries them."""

import re
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from schemas.cousins import Change
from schemas.geometry import ConvexPieces, Pose
from schemas.objects import PlacedObject, Table
from tableverse_factory.geometry.collision.penetration import measure_piece_penetrations
from tableverse_factory.geometry.math.transforms import quaternion_about_z, rotation_matrix
from tableverse_factory.geometry.mesh.mass_integrals import compute_signed_volume
from tableverse_factory.geometry.mesh.meshes import from_trimesh
from tableverse_factory.geometry.relations.support import find_piece_support
from tableverse_factory.stages.cousins.arrangement import Arrangement, place_object
from tableverse_factory.stages.cousins.changes import LEAST_MOVE_M, Draft
from tableverse_factory.stages.cousins.reflection import mirror_object
from tests.helpers.convex_layouts import box

TABLE = Table(np.array([0.1, 0.0]), np.array([0.5, 0.4]), 0.3, (150, 120, 90), 0.0)
SIDES = {"plate": (0.2, 0.16, 0.02), "cup": (0.06, 0.06, 0.1), "lid": (0.05, 0.04, 0.02), "can": (0.07, 0.05, 0.12)}
PLACES = {"plate": (0.0, 0.0, 0.01), "cup": (0.03, 0.0, 0.07), "lid": (0.03, 0.0, 0.13), "can": (0.3, 0.1, 0.06)}


def thing(name: str, sides: tuple[float, float, float], place: tuple[float, float, float]) -> PlacedObject:
    mesh = box(*sides)
    pose = Pose(np.array(place), quaternion_about_z(0.4))
    return PlacedObject(name, "thing", 1.0, mesh, 1.0, pose, pieces=ConvexPieces((mesh,), 1.0, 0.0, "convex"))


def stacked(seed: int = 0) -> Draft:
    """A cup with a lid on a plate, and a can beside them."""
    things = [thing(name, SIDES[name], PLACES[name]) for name in SIDES]
    return Draft(Arrangement(things, TABLE), np.random.default_rng(seed), {})


def carried(draft: Draft) -> set[tuple[str, str]]:
    names = list(draft.arrangement.objects)
    pairs = find_piece_support([place_object(item) for item in draft.arrangement.objects.values()])
    return {(names[i], names[j]) for i, j in pairs}


def test_what_stands_on_a_thing_moves_with_it_and_what_it_stands_on_stays():
    found = {unit.root: (set(unit.members), unit.stands) for unit in stacked().arrangement.list_units()}
    assert found == {
        "can": ({"can"}, True),
        "cup": ({"cup", "lid"}, False),
        "lid": ({"lid"}, False),
        "plate": ({"plate", "cup", "lid"}, True),
    }


def test_two_things_that_lean_on_each_other_move_as_one():
    """Two boards like the roof of a house: neither stands by itself."""
    tilt = np.deg2rad(20.0)
    boards = []
    for name, side in (("left", -1.0), ("right", 1.0)):
        board = thing(name, (0.01, 0.1, 0.2), (side * 0.0395, 0.0, 0.0957))
        pose = Pose(board.pose.position, np.array([np.cos(tilt / 2), 0.0, -side * np.sin(tilt / 2), 0.0]))
        boards.append(replace(board, pose=pose))
    units = Arrangement([*boards, thing("can", SIDES["can"], PLACES["can"])], TABLE).list_units()
    assert {frozenset(unit.members) for unit in units} == {frozenset({"left", "right"}), frozenset({"can"})}


def test_what_hangs_in_a_rim_falls_without_it_and_so_does_what_stands_on_it():
    """A wedge between two blocks touches them by steep faces only; a can stands on it."""
    wedge = from_trimesh(trimesh.convex.convex_hull([[x, y, z] for y in (-0.02, 0.02) for x, z in (
        (-0.05, 0.1), (0.05, 0.1), (-0.01, 0.0), (0.01, 0.0))]))  # fmt: skip
    hanging = replace(thing("wedge", (0.1, 0.1, 0.1), (0.0, 0.0, 0.05)), mesh=wedge)
    hanging = replace(hanging, pieces=ConvexPieces((wedge,), 1.0, 0.0, "convex"))
    level = np.array([1.0, 0.0, 0.0, 0.0])
    things = [
        replace(item, pose=Pose(item.pose.position, level))
        for item in (
            thing("can", (0.04, 0.03, 0.1), (0.0, 0.0, 0.2)),
            thing("left", (0.1, 0.1, 0.1), (-0.08, 0.0, 0.05)),
            thing("right", (0.1, 0.1, 0.1), (0.08, 0.0, 0.05)),
            hanging,
        )
    ]
    units = Arrangement(things, TABLE).list_units()
    for unit in units:
        assert "wedge" not in unit.members or "can" in unit.members
        assert not unit.members & {"left", "right"} or {"wedge", "can"} <= unit.members


@pytest.mark.parametrize("change", [Change.MOVE, Change.TURN, Change.SCALE])
def test_changes_keep_support_clearance_and_the_table(change):
    moved_off = 0
    for seed in range(12):
        draft = stacked(seed)
        before = dict(draft.arrangement.objects)
        draft.make(change)
        assert draft.changes, "there is room on this table"
        after = draft.arrangement.objects
        assert list(after) == list(before)
        changed = [name for name in before if after[name] is not before[name]]
        assert draft.arrangement.holds([after[name] for name in changed], 0.0)
        depths = measure_piece_penetrations(
            [item.pieces for item in after.values()],
            [item.pose for item in after.values()],
            [item.scale for item in after.values()],
        )
        assert max((depth for *_, depth in depths), default=0.0) < 1e-4
        lowest = min(place_object(item).points[:, 2].min() for item in after.values())
        assert lowest == pytest.approx(0.0, abs=1e-9)
        held = carried(draft)
        assert ("lid", "cup") in held or any("move:lid" in line for line in draft.changes)
        for name in after:  # whoever lost what carried it stands on the table
            if not any(pair[0] == name for pair in held):
                assert place_object(after[name]).points[:, 2].min() == pytest.approx(0.0, abs=1e-9)
        moved_off += ("cup", "plate") not in held
    assert moved_off or change is not Change.MOVE, "also what stands on another thing moves away from it"


def test_moves_are_far_enough_to_count_and_are_written_down_as_they_are():
    draft = stacked(3)
    before = dict(draft.arrangement.objects)
    draft.make(Change.MOVE)
    for line in draft.changes:
        names, offset = re.fullmatch(r"move:([\w+]+)=([-+.\d]+,[-+.\d]+)", line).groups()
        name = names.partition("+")[0]
        shift = (draft.arrangement.objects[name].pose.position - before[name].pose.position)[:2]
        assert np.linalg.norm(shift) >= LEAST_MOVE_M
        assert shift == pytest.approx([float(value) for value in offset.split(",")], abs=6e-4)


def test_removal_takes_what_carries_nothing_and_leaves_two_things():
    for seed in range(8):
        draft = stacked(seed)
        for _ in range(5):
            draft.make(Change.REMOVE)
        gone = [line.partition(":")[2] for line in draft.changes]
        assert len(draft.arrangement.objects) == 2 == len(SIDES) - len(gone)
        assert "plate" not in gone or {"cup", "lid"} <= set(gone[: gone.index("plate")])
        assert "cup" not in gone or "lid" in gone[: gone.index("cup")]


def test_what_takes_the_place_of_a_thing_stands_where_it_stood():
    draft = stacked(1)
    other = thing("elsewhere", (0.05, 0.06, 0.16), (3.0, 2.0, 0.08))
    draft.donors = {"can": [("scene/elsewhere", lambda: other)]}
    draft.make(Change.SWAP)
    assert draft.changes == ["swap:can=scene/elsewhere"]
    found = draft.arrangement.objects["can"]
    assert found.object_id == "can"
    low, high = place_object(found).points.min(axis=0), place_object(found).points.max(axis=0)
    assert low[2] == pytest.approx(0.0, abs=1e-9)
    assert (low + high)[:2] / 2 == pytest.approx(PLACES["can"][:2], abs=1e-3)


def test_what_cannot_stand_takes_no_place():
    draft = stacked(1)
    pole = thing("pole", (0.05, 0.05, 0.2), (0.0, 0.0, 0.1))
    tilted = replace(pole, pose=Pose(pole.pose.position, np.array([np.cos(0.35), np.sin(0.35), 0.0, 0.0])))
    draft.donors = {"can": [("scene/pole", lambda: tilted)]}
    draft.make(Change.SWAP)
    assert not draft.changes


def test_a_turn_is_one_where_something_changes():
    round_thing = thing("disc", (0.1, 0.1, 0.02), (0.0, 0.0, 0.01))
    mesh = from_trimesh(trimesh.creation.cylinder(0.05, 0.02, sections=64))
    pieces = ConvexPieces((mesh,), 1.0, 0.0, "convex")
    draft = Draft(Arrangement([replace(round_thing, mesh=mesh, pieces=pieces)], TABLE), np.random.default_rng(0), {})
    draft.make(Change.TURN)
    assert not draft.changes


def test_a_full_table_leaves_what_has_no_room():
    wall = [thing(f"box_{k}", (0.098, 0.5, 0.1), (0.1 * k, 0.0, 0.05)) for k in range(3)]
    wall = [replace(item, pose=Pose(item.pose.position, np.array([1.0, 0.0, 0.0, 0.0]))) for item in wall]
    narrow = Table(np.array([0.1, 0.0]), np.array([0.15, 0.25]), 0.0, TABLE.color, 0.0)
    draft = Draft(Arrangement(wall, narrow), np.random.default_rng(0), {})
    for change in (Change.MOVE, Change.TURN):
        draft.make(change)
    assert not draft.changes


def test_the_same_seed_makes_the_same_changes_and_another_others():
    lines = []
    for seed in (5, 5, 6):
        draft = stacked(seed)
        for change in (Change.SCALE, Change.MOVE, Change.TURN):
            draft.make(change)
        lines.append(draft.changes)
    assert lines[0] == lines[1] != lines[2]


def image_of(points):
    axes = rotation_matrix(quaternion_about_z(TABLE.yaw))
    middle = np.array([*TABLE.center_xy, 0.0])
    return (points - middle) @ (axes @ np.diag([-1.0, 1.0, 1.0]) @ axes.T) + middle


def test_a_mirror_image_is_one():
    """Every vertex lands on its image, faces look outwards, and twice gives the scene back."""
    mesh = from_trimesh(trimesh.convex.convex_hull([[0, 0, 0], [0.1, 0, 0], [0, 0.06, 0], [0.02, 0.01, 0.08]]))
    item = thing("wedge", (0.1, 0.1, 0.1), (0.2, 0.1, 0.0))
    item = replace(item, mesh=mesh, scale=1.2, pieces=ConvexPieces((mesh,), 1.0, 0.0, "convex"))
    image = mirror_object(item, TABLE)
    assert place_object(image).points == pytest.approx(image_of(place_object(item).points), abs=1e-12)
    assert compute_signed_volume(image.mesh) == pytest.approx(compute_signed_volume(mesh))
    again = mirror_object(image, TABLE)
    assert place_object(again).points == pytest.approx(place_object(item).points, abs=1e-12)


def test_what_is_symmetric_keeps_its_mesh_so_that_print_stays_legible():
    mesh = box(0.2, 0.03, 0.28)
    mesh = replace(mesh, vertices=mesh.vertices + np.array([0.02, 0.05, 0.01]))
    item = thing("book", (0.1, 0.1, 0.1), (0.2, 0.1, 0.13))
    item = replace(item, mesh=mesh, scale=0.9, pieces=ConvexPieces((mesh,), 1.0, 0.0, "convex"))
    image = mirror_object(item, TABLE)
    assert image.mesh is mesh
    expected, found = (
        np.unique(np.round(its, 9), axis=0) for its in (image_of(place_object(item).points), place_object(image).points)
    )
    assert found == pytest.approx(expected, abs=1e-9), "the same corners, others of its own"
    before, after = (rotation_matrix(its.pose.quaternion_wxyz) for its in (item, image))
    assert after[:, 2] == pytest.approx(before[:, 2]), "it stands upright"
    assert after[:, 1] == pytest.approx(image_of(before[:, 1][None])[0] - image_of(np.zeros((1, 3)))[0])
