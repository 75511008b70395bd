"""Composites: what is seen stays as seen, what is counted is repeated, nothing floats, nothing is lost silently."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from pydantic import ValidationError

from schemas.codec import encode
from schemas.config import Config, RectifyConfig
from schemas.geometry import Camera, ConvexPieces, Pose, TriangleMesh
from schemas.identity import check_id
from schemas.objects import Evidence, PlacedObject, PlacedObjects, Table
from tableverse_factory.core.seeding import make_rng
from tableverse_factory.geometry.collision.linear_sweep import LinearSweep
from tableverse_factory.geometry.collision.penetration import measure_piece_penetrations
from tableverse_factory.geometry.math.transforms import (
    identity_pose,
    multiply_quaternions,
    normalize_quaternion,
    quaternion_about_z,
    rotation_angle,
    translate_pose,
)
from tableverse_factory.geometry.mesh.hulls import make_bounded_hull
from tableverse_factory.geometry.mesh.meshes import from_trimesh, place_mesh
from tableverse_factory.geometry.relations.containers import make_hollow_vessel
from tableverse_factory.physics.bodies.prior_mass import make_prior_body
from tableverse_factory.physics.simulate.at_rest import GENTLE_S, HOLD_S
from tableverse_factory.sources.synthetic import utensils, vessels
from tableverse_factory.sources.synthetic.model import GeneratedObject
from tableverse_factory.stages.rectify.composites import AssembledLayout, assemble_composites, break_containment_cycles
from tableverse_factory.stages.rectify.drop_contents import (
    BUDGET_SPENT,
    CompositeMember,
    SimulationBudget,
    Surroundings,
    find_seen_starts,
)
from tableverse_factory.stages.rectify.fill_container import LEFT, RESTLESS, UNSTABLE, ContainerFilling
from tableverse_factory.stages.rectify.groups import form_entities
from tableverse_factory.stages.rectify.rigid_part import make_rigid_part
from tableverse_factory.stages.rectify.vertical import UP, lift_contents

TABLE = Table(np.zeros(2), np.ones(2), 0.0, (200, 200, 200), 0.0)
MUG, BOWL, SPOON = (
    make(np.random.default_rng(0)) for make in (vessels.make_mug, vessels.make_bowl, utensils.make_spoon)
)


def pieces_of(model: GeneratedObject) -> ConvexPieces:
    return ConvexPieces(tuple(make_bounded_hull(piece, 64, 1e-4) for piece in model.pieces), 1.0, 0.0, "cut")


def convex(mesh: TriangleMesh) -> ConvexPieces:
    return ConvexPieces((mesh,), 1.0, 0.0, "convex")


def ball(radius: float) -> TriangleMesh:
    return from_trimesh(trimesh.creation.icosphere(subdivisions=1, radius=radius))


def thing(
    name: str,
    mesh: TriangleMesh,
    at: tuple[float, float, float] = (0.0, 0.0, 0.0),
    inside: str | None = None,
    count: int = 1,
    quaternion: Sequence[float] = (1.0, 0.0, 0.0, 0.0),
) -> PlacedObject:
    pose = Pose(np.array(at), normalize_quaternion(np.array(quaternion)))
    return PlacedObject(name, "marble", 0.9, mesh, 1.0, pose, inside, count)


MUG_AT_HOME, MUG_PIECES = thing("mug", MUG.mesh), pieces_of(MUG)


def assembled(
    *things: tuple[PlacedObject, ConvexPieces], config: RectifyConfig | None = None, evidence: Evidence | None = None
) -> AssembledLayout:
    item = PlacedObjects("scene", TABLE, tuple(o for o, _ in things), evidence)
    whole = Config(rectify=config or RectifyConfig())
    return assemble_composites(item, [pieces for _, pieces in things], whole, make_rng(0, "scene", "rectify"))


def names(result: AssembledLayout) -> list[str]:
    return [o.object_id for o in result.placed.objects]


def pose_of(result: AssembledLayout, name: str) -> Pose:
    return result.poses[names(result).index(name)]


def check_sound(result: AssembledLayout) -> None:
    """What always holds: free on the pieces, nothing for `fill` to lift, every content in its container."""
    scales = [o.scale for o in result.placed.objects]
    assert measure_piece_penetrations(result.pieces, result.poses, scales) == []
    assert len(set(names(result))) == len(names(result)) == len(result.poses) == len(result.pieces)
    parts = [
        make_rigid_part(replace(o, pose=pose), its)
        for o, pose, its in zip(result.placed.objects, result.poses, result.pieces, strict=True)
    ]
    lifted = lift_contents(parts, form_entities(parts), RectifyConfig().clearance_m)
    assert max(float(part.body.offset[2]) for part in lifted) == 0.0
    meshes = {
        o.object_id: place_mesh(o.mesh, pose, o.scale)
        for o, pose in zip(result.placed.objects, result.poses, strict=True)
    }
    for o in result.placed.objects:
        if o.contained_in is not None:
            assert make_hollow_vessel(meshes[o.contained_in]).holds(meshes[o.object_id]), o.object_id
        assert o.count == 1
        check_id(o.object_id)


@pytest.mark.heavy
def test_twelve_marbles_fill_a_mug_each_an_object_of_its_own() -> None:
    marble = ball(0.011)
    result = assembled(
        (MUG_AT_HOME, MUG_PIECES), (thing("marble", marble, (0.0, 0.0, 0.03), "mug", count=12), convex(marble))
    )
    check_sound(result)
    assert names(result) == ["mug", "marble", *(f"marble_{k}" for k in range(2, 13))]
    assert [o.copy_of for o in result.placed.objects] == [None, None, *["marble"] * 11]
    assert result.placed.left_out == ()
    for o in result.placed.objects[2:]:
        assert (o.label, o.label_confidence, o.contained_in) == ("marble", 0.9, "mug")


@pytest.mark.heavy
def test_a_mug_of_marbles_does_not_depend_on_the_order_of_the_file() -> None:
    marble = ball(0.013)
    things = [
        (MUG_AT_HOME, MUG_PIECES),
        (thing("b", marble, (0.0, 0.0, 0.03), "mug", count=3), convex(marble)),
        (thing("a", marble, (0.01, 0.0, 0.06), "mug"), convex(marble)),
    ]
    one, two = assembled(*things), assembled(*things[::-1])
    assert encode(assembled(*things).poses) == encode(one.poses)
    assert sorted(names(one)) == sorted(names(two))
    for name in names(one):
        assert encode(pose_of(one, name)) == encode(pose_of(two, name))


@pytest.mark.heavy
def test_a_spoon_that_leans_on_the_rim_as_seen_stays_there() -> None:
    lean = (np.cos(-0.62), 0.0, np.sin(-0.62), 0.0)
    spoon = thing("spoon", SPOON.mesh, (0.022, 0.004, 0.09), "mug", quaternion=lean)
    first = assembled((MUG_AT_HOME, MUG_PIECES), (spoon, pieces_of(SPOON)))
    check_sound(first)
    rest = pose_of(first, "spoon")
    assert rotation_angle(rest.quaternion_wxyz, spoon.pose.quaternion_wxyz) < 0.6
    # Seen at rest, it is left alone.
    again = assembled((MUG_AT_HOME, MUG_PIECES), (replace(spoon, pose=rest), pieces_of(SPOON)))
    assert np.linalg.norm(pose_of(again, "spoon").position - rest.position) < 5e-4
    assert rotation_angle(pose_of(again, "spoon").quaternion_wxyz, rest.quaternion_wxyz) < 0.01


@pytest.mark.heavy
def test_a_spoon_seen_a_little_through_the_wall_is_pushed_in_not_lifted_out() -> None:
    lean = (np.cos(-0.62), 0.0, np.sin(-0.62), 0.0)
    spoon = thing("spoon", SPOON.mesh, (0.032, 0.004, 0.085), "mug", quaternion=lean)
    assert measure_piece_penetrations([MUG_PIECES, pieces_of(SPOON)], [identity_pose(), spoon.pose], [1.0, 1.0])
    result = assembled((MUG_AT_HOME, MUG_PIECES), (spoon, pieces_of(SPOON)))
    check_sound(result)
    assert np.linalg.norm(pose_of(result, "spoon").position - spoon.pose.position) < 0.02


def test_the_container_stands_still_wherever_it_stands() -> None:
    pose = Pose(np.array([0.3, -0.2, 0.05]), quaternion_about_z(1.1))
    marble = ball(0.012)
    mug = replace(MUG_AT_HOME, pose=pose)
    result = assembled((mug, MUG_PIECES), (thing("marble", marble, (0.3, -0.2, 0.1), "mug", 3), convex(marble)))
    check_sound(result)
    assert encode(pose_of(result, "mug")) == encode(pose)


@pytest.mark.heavy
def test_what_is_too_large_is_left_out_with_the_reason_and_takes_its_own_contents_along() -> None:
    huge, marble = from_trimesh(trimesh.creation.box((0.3, 0.3, 0.3))), ball(0.01)
    result = assembled(
        (MUG_AT_HOME, MUG_PIECES),
        (thing("huge", huge, (0.0, 0.0, 0.3), "mug"), convex(huge)),
        (thing("inner", marble, (0.0, 0.0, 0.3), "huge"), convex(marble)),
    )
    assert names(result) == ["mug"]
    left = dict(result.placed.left_out)
    assert sorted(left) == ["huge", "inner"]
    assert "does not fit into mug" in left["huge"]
    assert "huge" in left["inner"]


@pytest.mark.heavy
def test_copies_that_do_not_fit_are_counted_under_the_first_missing_id() -> None:
    big = ball(0.028)
    result = assembled((MUG_AT_HOME, MUG_PIECES), (thing("ball", big, (0.0, 0.0, 0.05), "mug", 100), convex(big)))
    check_sound(result)
    present = len(names(result)) - 1
    assert 1 <= present < 20
    [(name, reason)] = result.placed.left_out
    assert name == f"ball_{present + 1}"
    assert f"{present + 1} to 100" in reason


def test_no_more_things_than_configured_those_that_were_seen_first() -> None:
    marble = ball(0.01)
    result = assembled(
        (MUG_AT_HOME, MUG_PIECES),
        (thing("a", marble, (0.0, 0.0, 0.03), "mug", 9), convex(marble)),
        (thing("b", marble, (0.01, 0.0, 0.06), "mug"), convex(marble)),
        config=RectifyConfig(max_contents=4),
    )
    assert names(result) == ["mug", "a", "a_2", "a_3", "b"]
    assert dict(result.placed.left_out).keys() == {"a_4"}


@pytest.mark.heavy
def test_contents_of_contents_are_filled_after_them() -> None:
    small = bounded = vessels.make_cup(np.random.default_rng(1))
    marble = ball(0.009)
    bowl = thing("bowl", BOWL.mesh)
    cup = thing("cup", bounded.mesh, (0.0, 0.0, 0.01), "bowl")
    inside = thing("marble", marble, (0.0, 0.0, 0.05), "cup", 2)
    result = assembled((bowl, pieces_of(BOWL)), (cup, pieces_of(small)), (inside, convex(marble)))
    check_sound(result)
    assert names(result) == ["bowl", "cup", "marble", "marble_2"]


@pytest.mark.heavy
def test_contents_follow_a_container_that_itself_falls() -> None:
    # The cup hovers 3 cm over the bowl's floor, the marble in it: both come down together.
    cup_model, marble = vessels.make_cup(np.random.default_rng(1)), ball(0.012)
    bowl = thing("bowl", BOWL.mesh)
    cup = thing("cup", cup_model.mesh, (0.0, 0.0, 0.04), "bowl")
    inside = thing("marble", marble, (0.0, 0.0, 0.06), "cup")
    result = assembled((bowl, pieces_of(BOWL)), (cup, pieces_of(cup_model)), (inside, convex(marble)))
    check_sound(result)
    assert pose_of(result, "marble").position[2] < 0.05


def test_a_circle_of_containers_ends_at_the_largest() -> None:
    small, large = ball(0.02), ball(0.05)
    found = break_containment_cycles(
        [thing("a", small, inside="b"), thing("b", large, inside="a"), thing("c", small, inside="gone")]
    )
    assert [o.contained_in for o in found] == ["b", None, None]


def test_ids_stay_unique_and_safe() -> None:
    marble, long_name = ball(0.01), "x" * 80
    result = assembled(
        (MUG_AT_HOME, MUG_PIECES),
        (thing(long_name, marble, (0.0, 0.0, 0.03), "mug", 2), convex(marble)),
        (thing("m", marble, (0.01, 0.0, 0.06), "mug", 2), convex(marble)),
        (thing("M_2", marble, (0.5, 0.0, 0.01)), convex(marble)),
    )
    check_sound(result)
    assert len(names(result)) == 6
    assert len({name.lower() for name in names(result)}) == 6


@pytest.mark.heavy
def test_copies_have_the_pixels_of_what_they_repeat() -> None:
    marble = ball(0.01)
    evidence = Evidence(b"jpg", b"png", (7, 3, 9), Camera(100.0, 100.0, 1.0, 1.0, 2, 2), identity_pose())
    result = assembled(
        (MUG_AT_HOME, MUG_PIECES),
        (thing("marble", marble, (0.0, 0.0, 0.03), "mug", 3), convex(marble)),
        (thing("far", marble, (0.5, 0.0, 0.01)), convex(marble)),
        evidence=evidence,
    )
    assert result.placed.evidence is not None
    assert names(result) == ["mug", "marble", "marble_2", "marble_3", "far"]
    assert result.placed.evidence.object_pixels == (7, 3, 3, 3, 9)


def test_things_counted_outside_of_a_container_are_named() -> None:
    marble = ball(0.01)
    result = assembled((thing("marble", marble, (0.0, 0.0, 0.01), count=5), convex(marble)))
    assert names(result) == ["marble"]
    [(name, reason)] = result.placed.left_out
    assert name == "marble_2"
    assert "2 to 5" in reason


def test_nothing_floats_on_pieces_that_close_a_vessel() -> None:
    closed = ConvexPieces((make_bounded_hull(MUG.mesh.vertices, 64, 1e-4),), 2.0, 0.05, "convex")
    marble = ball(0.011)
    result = assembled((MUG_AT_HOME, closed), (thing("marble", marble, (0.0, 0.0, 0.15), "mug"), convex(marble)))
    assert names(result) == ["mug"]
    assert "marble" in dict(result.placed.left_out)


@pytest.mark.heavy
@pytest.mark.parametrize("turn", [np.pi / 2, 2.2])
def test_a_container_upside_down_keeps_nothing(turn: float) -> None:
    flip = multiply_quaternions(quaternion_about_z(turn), np.array([0.0, 1.0, 0.0, 0.0]))
    mug = replace(MUG_AT_HOME, pose=Pose(np.array([0.0, 0.0, 0.1]), normalize_quaternion(flip)))
    marble = ball(0.01)
    result = assembled((mug, MUG_PIECES), (thing("marble", marble, (0.0, 0.0, 0.05), "mug"), convex(marble)))
    # What lies on its foot is over it, as on a dish; what falls out is left out. Either way nothing floats.
    check_sound(result)


def member(item: PlacedObject, pieces: ConvexPieces) -> CompositeMember:
    return CompositeMember(item, pieces, make_prior_body(item, pieces, item.pose))


def filling(
    root: PlacedObject = MUG_AT_HOME, fall_time_s: float = 1.0, budget: SimulationBudget | None = None
) -> ContainerFilling:
    config = Config(rectify=RectifyConfig().model_copy(update={"fall_time_s": fall_time_s}))
    return ContainerFilling(
        member(root, MUG_PIECES), config, make_rng(0, "scene", "rectify"), budget or SimulationBudget()
    )


def marble_at(name: str, x: float, z: float) -> CompositeMember:
    marble = ball(0.011)
    return member(thing(name, marble, (x, 0.0, z), "mug"), convex(marble))


@pytest.mark.heavy
def test_what_still_moves_when_the_time_is_up_is_not_in() -> None:
    short = filling(fall_time_s=0.5)
    assert not short.put(marble_at("marble", 0.0, 0.05), short.holder("mug"))
    assert list(short.members) == ["mug"]
    assert filling().put(marble_at("marble", 0.0, 0.05), short.holder("mug"))


@pytest.mark.heavy
def test_what_never_comes_to_rest_together_is_named() -> None:
    assert MUG.cavity is not None
    # 1.2 m deep: what starts at its top is in the air when the time is up, twice.
    tall = filling(replace(MUG_AT_HOME, scale=12.0), fall_time_s=0.65)
    both = (marble_at("low", 0.0, 12 * MUG.cavity.floor + 0.012), marble_at("high", 0.1, 1.1))
    tall.members.update((m.item.object_id, m) for m in both)
    assert tall.relax() == {"high": RESTLESS}
    assert list(tall.members) == ["mug", "low"]


def test_what_breaks_the_simulation_is_named() -> None:
    broken = filling()
    both = (marble_at("sane", 0.0, 0.03), marble_at("mad", 2e10, 0.03))
    broken.members.update((m.item.object_id, m) for m in both)
    assert broken.relax() == {"mad": UNSTABLE}
    assert list(broken.members) == ["mug", "sane"]


def test_a_fall_gets_more_time_than_measuring_rest_takes() -> None:
    with pytest.raises(ValidationError, match="fall_time_s"):
        RectifyConfig(fall_time_s=GENTLE_S + HOLD_S)


@pytest.mark.parametrize("spent", [SimulationBudget(dropping_s=0.0), SimulationBudget(comparisons=0)])
def test_nothing_is_dropped_when_the_budget_is_spent(spent: SimulationBudget) -> None:
    before = replace(spent)
    assert not filling(budget=spent).put(marble_at("marble", 0.0, 0.05), filling().holder("mug"))
    assert spent == before


def test_starts_come_nearest_first_as_if_every_push_had_been_searched_to_its_end() -> None:
    assert MUG.cavity is not None
    marble, mug = marble_at("marble", MUG.cavity.rim_radius, 0.05), member(MUG_AT_HOME, MUG_PIECES)
    holder, level = filling().holder("mug"), [np.array([np.cos(a), np.sin(a), 0.0]) for a in np.arange(8) * np.pi / 4]
    directions = [UP, *level, *((flat + UP) / np.sqrt(2.0) for flat in level)]
    ways = [LinearSweep(direction).find_first_clear([marble.solid], [mug.solid], 0.0005) for direction in directions]
    order = np.argsort(ways, kind="stable")
    ends = [marble.at(translate_pose(marble.pose, ways[k] * directions[k])) for k in order]
    budget = SimulationBudget()
    starts = list(find_seen_starts(marble, Surroundings([mug.solid], 0.0005, budget), holder))
    held = [end.pose.position for end in ends if holder.holds(end.mesh)]
    assert 1 < len(held) < len(directions)
    np.testing.assert_array_equal([start.pose.position for start in starts], held)
    assert budget.comparisons == SimulationBudget().comparisons - len(directions) * len(MUG_PIECES.hulls)


def test_freeing_together_ends_with_its_budget_and_says_so() -> None:
    poor = filling(budget=SimulationBudget(freeing_s=0.0))
    both = (marble_at("a", 0.0, 0.03), marble_at("b", 0.0, 0.06))
    poor.members.update((m.item.object_id, m) for m in both)
    assert poor.relax() == {"a": BUDGET_SPENT, "b": BUDGET_SPENT}


def test_containers_share_one_budget() -> None:
    shared = SimulationBudget()
    assert filling(budget=shared).put(marble_at("one", 0.0, 0.05), filling().holder("mug"))
    once = replace(shared)
    assert once.dropping_s < SimulationBudget().dropping_s
    assert once.comparisons < SimulationBudget().comparisons
    assert filling(budget=shared).put(marble_at("two", 0.0, 0.05), filling().holder("mug"))
    assert shared.dropping_s < once.dropping_s


@pytest.mark.slow
def test_a_mug_into_which_sixty_spoons_should_go_ends_and_says_what_is_left_out() -> None:
    lean, pieces = (np.cos(-0.62), 0.0, np.sin(-0.62), 0.0), pieces_of(SPOON)
    spoons = [thing(f"s{k:02d}", SPOON.mesh, (0.02, 0.004, 0.09), "mug", quaternion=lean) for k in range(60)]
    result = assembled((MUG_AT_HOME, MUG_PIECES), *((spoon, pieces) for spoon in spoons))
    check_sound(result)
    assert len(names(result)) - 1 + len(result.placed.left_out) == 60
    assert BUDGET_SPENT in dict(result.placed.left_out).values()


@pytest.mark.heavy
def test_what_leaves_when_all_are_freed_is_named_and_the_rest_still_comes_to_rest() -> None:
    marble, cup = ball(0.011), vessels.make_cup(np.random.default_rng(1))
    mug = filling(fall_time_s=3.0)
    inside = [
        member(thing("in", marble, (0.0, 0.0, 0.05), "mug"), convex(marble)),
        member(thing("beside", cup.mesh, (0.2, 0.0, 0.05), "mug"), pieces_of(cup)),
        member(thing("inner", marble, (0.2, 0.0, 0.09), "beside"), convex(marble)),
    ]
    mug.members.update((m.item.object_id, m) for m in inside)
    assert mug.relax()["beside"] == LEFT
    assert list(mug.members) == ["mug", "in"]
    assert MUG.cavity is not None
    assert mug.members["in"].pose.position[2] == pytest.approx(MUG.cavity.floor + 0.011, abs=0.002)
