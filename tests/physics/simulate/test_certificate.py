"""The certificate against planted truth, on our own scenes and on anybody's MJCF."""

from collections.abc import Sequence

import mujoco
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from schemas.geometry import ConvexPieces, Pose, TriangleMesh
from tableverse_factory.geometry.collision.penetration import measure_piece_penetrations
from tableverse_factory.geometry.math.transforms import normalize_quaternion
from tableverse_factory.geometry.mesh.meshes import from_trimesh
from tableverse_factory.physics.mjcf.pose_history import PoseHistory
from tableverse_factory.physics.mjcf.slab import fit_slab
from tableverse_factory.physics.mjcf.spec import make_scene_body, make_scene_files
from tableverse_factory.physics.simulate.certificate import certify, find_deepest_contact, measure_model
from tests.helpers.simple_scenes import TABLE, UPRIGHT, ball, box

SLAB = fit_slab(TABLE, [], [], [])
CUBE = box(0.05, 0.05, 0.05)


def at(x: float, y: float, z: float) -> Pose:
    return Pose(np.array([x, y, z]), UPRIGHT)


def model_of(things: Sequence[tuple[TriangleMesh, Pose]]) -> mujoco.MjModel:
    bodies = [make_scene_body(f"obj_{k:03d}", mesh, (mesh,), 1.0, 0.2, pose) for k, (mesh, pose) in enumerate(things)]
    return make_scene_files(bodies, SLAB).model()


def test_a_box_on_the_table_is_at_rest_and_free() -> None:
    found = measure_model(model_of([(CUBE, at(0, 0, 0.02499))]))
    assert found.at_rest
    assert not found.colliding(0.001)
    assert found.drift_m < 1e-4
    assert found.bodies == ("obj_000",)


@pytest.mark.parametrize("depth", [0.0002, 0.003])
def test_a_planted_penetration_is_found_on_pieces_and_on_meshes(depth: float) -> None:
    found = measure_model(model_of([(CUBE, at(0, 0, 0.025)), (CUBE, at(0.05 - depth, 0.003, 0.025))]))
    for measured, pair in (found.pieces, found.meshes):
        assert measured == pytest.approx(depth, abs=max(1e-5, 0.05 * depth))
        assert pair == "obj_000 & obj_001"
    assert found.colliding(0.001) == (depth > 0.001)


def test_sinking_into_the_table_counts() -> None:
    found = measure_model(model_of([(CUBE, at(0, 0, 0.025 - 0.003))]))
    assert found.pieces[0] == pytest.approx(0.003, abs=2e-4)
    assert found.meshes[0] == pytest.approx(0.003, abs=2e-4)
    assert found.meshes[1] == "obj_000 & world"


def test_a_collision_of_meshes_behind_free_pieces_is_found() -> None:
    small = box(0.04, 0.04, 0.04)
    bodies = [
        make_scene_body("obj_000", CUBE, (small,), 1.0, 0.2, at(0, 0, 0.025)),
        make_scene_body("obj_001", CUBE, (small,), 1.0, 0.2, at(0.047, 0, 0.025)),
    ]
    found = measure_model(make_scene_files(bodies, SLAB).model())
    assert found.pieces[0] == 0.0
    assert found.meshes[0] == pytest.approx(0.003, abs=1e-5)
    assert found.colliding(0.001)


@pytest.mark.heavy
@settings(max_examples=40, deadline=None)
@given(
    st.tuples(*[st.floats(-0.03, 0.03)] * 3),
    st.tuples(*[st.floats(-1.0, 1.0)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1),
)
def test_piece_depths_agree_with_an_independent_computation(
    offset: tuple[float, float, float], quaternion: tuple[float, float, float, float]
) -> None:
    poses = [
        at(0, 0, 1.0),
        Pose(np.array(offset) + np.array([0.03, 0, 1.0]), normalize_quaternion(np.array(quaternion))),
    ]
    meshes = [ball(0.03), box(0.05, 0.03, 0.06)]
    pieces = [ConvexPieces((mesh,), 1.0, 0.0, "convex") for mesh in meshes]
    ours, _ = find_deepest_contact(model_of(list(zip(meshes, poses, strict=True))), poses)
    coal = max((depth for _, _, depth in measure_piece_penetrations(pieces, poses, [1.0, 1.0])), default=0.0)
    # Both expand a polytope and stop a little early, each in its own direction: deep overlaps differ by 1.5 % at most.
    assert ours == pytest.approx(coal, rel=0.02, abs=1e-5)


def test_an_object_in_mid_air_falls_and_is_named() -> None:
    found = measure_model(model_of([(CUBE, at(0, 0, 0.025)), (CUBE, at(2.0, 0, 0.025))]))
    assert found.fell == ("obj_001",)
    assert not found.at_rest
    assert "obj_000" not in found.moved


def test_sliding_is_drift() -> None:
    model = model_of([(CUBE, at(0, 0, 0.025))])
    model.opt.gravity[:] = [9.81 * 0.9, 0, -9.81]
    found = measure_model(model)
    assert found.moved == ("obj_000",)
    assert not found.at_rest


def test_contents_that_left_their_container_are_named() -> None:
    tub = from_trimesh(trimesh.creation.box((0.12, 0.12, 0.002)))
    inside, heaped, outside = at(0, 0, 0.03), at(0.02, 0, 0.045), at(0.2, 0, 0.02)
    things = [(tub, at(0, 0, 0.001)), (ball(0.02), inside), (ball(0.02), heaped), (ball(0.02), outside)]
    history = PoseHistory(contained_in={f"obj_{k:03d}": "obj_000" for k in (1, 2, 3)})
    certificate, _ = certify(model_of(things), history, 0.001)
    # A tray holds what lies on it and what is heaped over it, and not what lies beside it.
    assert certificate.left_container == ("obj_003",)


def test_before_and_displacement_come_from_the_history() -> None:
    model = model_of([(CUBE, at(0, 0, 0.025)), (CUBE, at(0.06, 0, 0.025))])
    history = PoseHistory(
        placed={"obj_000": at(0, 0, 0.025), "obj_001": at(0.03, 0.04, 0.025)},
        rectified={"obj_000": at(0, 0, 0.025), "obj_001": at(0.046, 0, 0.025)},
    )
    certificate, _ = certify(model, history, 0.001)
    assert dict(certificate.displacement_m) == {
        "obj_000": pytest.approx(0.0, abs=1e-9),
        "obj_001": pytest.approx(0.05, abs=1e-9),
    }
    assert certificate.piece_penetration_before_m == pytest.approx(0.004, abs=1e-5)
    assert certificate.mesh_penetration_before_m == pytest.approx(0.004, abs=1e-5)
    assert certificate.piece_penetration_m < 1e-6
    assert not certificate.colliding


FOREIGN = """
<mujoco>
  <worldbody>
    <geom type="plane" size="0 0 1"/>
    <body pos="0 0 {z}"><freejoint/><geom type="{kind}" size="{size}" density="500"/></body>
    <body name="cart" pos="0.5 0 0.05"><freejoint/>
      <geom type="box" size="0.1 0.05 0.05" group="4"/>
      <body pos="0 0 0.05">
        <joint type="hinge" axis="0 0 1"/><geom type="box" size="0.02 0.02 0.02" pos="0 0 0.0201"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.mark.parametrize(
    ("kind", "size", "height"),
    [
        ("box", "0.03 0.03 0.03", 0.03),
        ("sphere", "0.03", 0.03),
        ("capsule", "0.02 0.03", 0.05),
        ("cylinder", "0.02 0.03", 0.03),
        ("ellipsoid", "0.02 0.03 0.04", 0.04),
    ],
)
def test_foreign_scenes_of_primitives_on_a_plane(kind: str, size: str, height: float) -> None:
    sunk = mujoco.MjModel.from_xml_string(FOREIGN.format(z=height - 0.003, kind=kind, size=size))
    found = measure_model(sunk)
    assert found.bodies == ("#1", "cart")
    assert found.pieces[0] == pytest.approx(0.003, abs=1e-4)
    assert found.meshes[0] == pytest.approx(0.003, abs=2e-4)
    assert found.meshes[1] == "#1 & world"
    above = mujoco.MjModel.from_xml_string(FOREIGN.format(z=height + 0.001, kind=kind, size=size))
    assert not measure_model(above).colliding(1e-4)


def test_a_mesh_that_had_to_be_closed_is_named() -> None:
    sheet = TriangleMesh(CUBE.vertices, CUBE.faces[:-1])
    body = make_scene_body("obj_000", sheet, (CUBE,), 1.0, 0.2, at(0, 0, 0.025))
    assert measure_model(make_scene_files([body], SLAB).model()).repaired == ("obj_000: filled",)
