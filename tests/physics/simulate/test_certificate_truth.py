"""The certificate's depths and drifts against mathematics and against a second computation, on MJCF files alone."""

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import open3d
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from schemas.geometry import TriangleMesh
from tableverse_factory.geometry.math.transforms import identity_pose
from tableverse_factory.geometry.mesh.meshes import from_trimesh
from tableverse_factory.physics.simulate.certificate import Measurement, measure_model
from tableverse_factory.physics.simulate.model_solids import GeomSolid, ModelBody, find_deepest_overlaps

DEPTHS_MM = (0.05, 0.5, 2.0, 10.0)
ANYWHERE = [(0.0, 0.0, 0.0), (30.0, -20.0, 75.0), (120.0, 40.0, 10.0)]


def of_xml(bodies: str, assets: str = "", files: dict[str, bytes] | None = None) -> Measurement:
    text = f"<mujoco><option gravity='0 0 0'/><asset>{assets}</asset><worldbody>{bodies}</worldbody></mujoco>"
    return measure_model(mujoco.MjModel.from_xml_string(text, files or {}))


def body(geom: str, position: np.ndarray, turn: Rotation) -> str:
    x, y, z, w = turn.as_quat()
    pos = " ".join(f"{value:.12f}" for value in position)
    return f"<body pos='{pos}' quat='{w:.12f} {x:.12f} {y:.12f} {z:.12f}'><freejoint/>{geom}</body>"


def pair(a: str, b: str, apart: np.ndarray, euler: tuple[float, float, float]) -> str:
    """Two bodies, the second displaced, and both turned together."""
    turn = Rotation.from_euler("xyz", euler, degrees=True)
    return body(a, np.array([0.0, 0.0, 1.0]), turn) + body(b, np.array([0.0, 0.0, 1.0]) + turn.apply(apart), turn)


def box(x: float, y: float, z: float) -> str:
    return f"<geom type='box' size='{x} {y} {z}'/>"


def obj(mesh: trimesh.Trimesh) -> bytes:
    return str(mesh.export(file_type="obj", digits=12)).encode()


@pytest.mark.parametrize("euler", ANYWHERE)
@pytest.mark.parametrize("mm", DEPTHS_MM)
def test_boxes_face_to_face(mm: float, euler: tuple[float, float, float]) -> None:
    depth = mm * 1e-3
    found = of_xml(pair(box(0.03, 0.04, 0.05), box(0.02, 0.03, 0.04), np.array([0.05 - depth, 0.004, 0.003]), euler))
    assert found.meshes[0] == pytest.approx(depth, abs=1e-6)
    assert found.pieces[0] == pytest.approx(depth, abs=1e-5)


@pytest.mark.parametrize("euler", ANYWHERE)
@pytest.mark.parametrize("mm", DEPTHS_MM)
def test_balls(mm: float, euler: tuple[float, float, float]) -> None:
    depth = mm * 1e-3
    ball = "<geom type='sphere' size='0.03'/>"
    found = of_xml(pair(ball, ball, np.array([0.06 - depth, 0.0, 0.0]), euler))
    assert found.pieces[0] == pytest.approx(depth, abs=1e-7)
    assert found.meshes[0] == pytest.approx(depth, abs=6e-5)  # a ball of 5,120 triangles


@pytest.mark.parametrize("mm", DEPTHS_MM)
def test_meshes_with_their_own_scale_and_frame(mm: float) -> None:
    """MuJoCo moves meshes to their centre of mass and axes of inertia: the depth must not notice."""
    depth = mm * 1e-3
    lshape = trimesh.util.concatenate(
        [
            trimesh.creation.box(bounds=[[3, 0, 0], [7, 1, 1]]),
            trimesh.creation.box(bounds=[[3, 1, 0], [4, 3, 1]]),
        ]
    )
    joined = trimesh.boolean.union(list(lshape.split()), engine="manifold")
    asset = (
        "<mesh name='l' file='l.obj' scale='0.01 0.02 0.03'/>"  # 4, 6 and 3 cm large; it begins 3 cm from its origin
    )
    geom = "<geom type='mesh' mesh='l'/>"
    foot = pair(geom, box(0.02, 0.02, 0.02), np.array([0.07 + 0.02 - depth, 0.01, 0.015]), (10.0, 20.0, 30.0))
    assert of_xml(foot, asset, {"l.obj": obj(joined)}).meshes[0] == pytest.approx(depth, abs=2e-6)
    notch = pair(geom, box(0.005, 0.005, 0.005), np.array([0.055, 0.04, 0.015]), (10.0, 20.0, 30.0))
    found = of_xml(notch, asset, {"l.obj": obj(joined)})
    assert found.meshes[0] == 0.0  # in the notch, where MuJoCo's hull of the mesh is
    assert found.pieces[0] > 0.004


def test_one_inside_another_counts_its_own_thickness() -> None:
    """A surface nowhere crosses another, yet all of the smaller one is shared."""
    within = of_xml(pair(box(0.05, 0.05, 0.05), box(0.004, 0.01, 0.01), np.zeros(3), (5.0, 6.0, 7.0)))
    assert within.meshes[0] == pytest.approx(0.008, abs=1e-6)
    assert within.colliding(0.001)
    assert within.pieces[0] > 0.008  # the way out is longer


@pytest.mark.heavy
@settings(max_examples=25, deadline=None)
@given(
    st.tuples(*[st.floats(-0.05, 0.05)] * 3),
    st.tuples(*[st.floats(-180.0, 180.0)] * 3),
)
def test_depths_of_boxes_lie_between_two_other_computations(
    offset: tuple[float, float, float], euler: tuple[float, float, float]
) -> None:
    """Never less than the deepest sampled point of one in the other, never more than the way out (by MuJoCo)."""
    half = np.array([0.03, 0.02, 0.04]), np.array([0.025, 0.035, 0.015])
    turn = Rotation.from_euler("xyz", euler, degrees=True)
    xml = body(box(*half[0]), np.zeros(3), Rotation.identity()) + body(box(*half[1]), np.array(offset), turn)
    found = of_xml(xml)
    grid = np.stack(np.meshgrid(*[np.linspace(-1, 1, 25)] * 3), axis=-1).reshape(-1, 3)
    first, second = grid * half[0], turn.apply(grid * half[1]) + np.array(offset)
    inside = max(_depth(turn.inv().apply(first - np.array(offset)), half[1], first, half[0]),
                 _depth(second, half[0], turn.inv().apply(second - np.array(offset)), half[1]))  # fmt: skip
    assert found.meshes[0] >= 2.0 * inside - 1e-9
    assert found.meshes[0] <= found.pieces[0] + 1e-4


def _depth(points: np.ndarray, half: np.ndarray, own: np.ndarray, own_half: np.ndarray) -> float:
    """Radius of the largest ball about one of the points that lies in both boxes, given in the frames of both."""
    room = np.minimum((half - np.abs(points)).min(axis=1), (own_half - np.abs(own)).min(axis=1))
    return max(float(room.max()), 0.0)


@pytest.mark.parametrize("mm", [0.5, 2.0, 10.0])
def test_scans_against_sampled_signed_distances(mm: float) -> None:
    """Two bumpy bodies; signed distances by casting rays know nothing of Booleans."""
    blob = trimesh.creation.icosphere(3, 0.04)
    blob.vertices *= (1 + 0.15 * np.sin(5 * np.arctan2(blob.vertices[:, 1], blob.vertices[:, 0])))[:, None]
    other = blob.copy()
    reach = _first_touch(blob) - mm * 1e-3
    other.apply_translation([reach, 0.0, 0.0])
    deepest = max(_inside(blob, other.vertices).max(), _inside(other, blob.vertices).max())
    asset = "<mesh name='a' file='a.obj'/>"
    geom = "<geom type='mesh' mesh='a'/>"
    found = of_xml(pair(geom, geom, np.array([reach, 0.0, 0.0]), (0, 0, 0)), asset, {"a.obj": obj(blob)})
    assert 0.8 * deepest <= found.meshes[0] <= mm * 1e-3 + 1e-6


def _inside(mesh: trimesh.Trimesh, points: np.ndarray) -> np.ndarray:
    """How deep points lie inside, negative outside."""
    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32))
    return -scene.compute_signed_distance(np.asarray(points, dtype=np.float32)).numpy()


def _first_touch(blob: trimesh.Trimesh) -> float:
    """Distance along x at which a copy just touches, by bisection on signed distances of vertices."""
    low, high = 0.0, 0.2
    for _ in range(30):
        middle = (low + high) / 2
        apart = _inside(blob, np.add(blob.vertices, [middle, 0, 0])).max() <= 0.0
        low, high = (low, middle) if apart else (middle, high)
    return high


@pytest.mark.parametrize(("degrees", "friction"), [(20.0, 0.5), (35.0, 0.5), (45.0, 0.8)])
def test_drift_on_a_slope_is_what_galilei_and_coulomb_say(degrees: float, friction: float) -> None:
    angle = np.deg2rad(degrees)
    x, z = -np.sin(angle / 2), np.cos(angle / 2)  # about y, so that the slope falls towards -x
    up = 0.02 * np.array([-np.sin(angle), 0.0, np.cos(angle)])
    xml = f"""<mujoco><option timestep="0.001" cone="elliptic" impratio="100" noslip_iterations="5"
      integrator="implicitfast"/>
      <default><geom friction="{friction} 0.005 0.0001"/></default><worldbody>
      <geom type="plane" size="500 500 1" quat="{z} 0 {x} 0"/>
      <body name="slider" pos="{up[0]} {up[1]} {up[2]}" quat="{z} 0 {x} 0"><freejoint/>
        <geom type="box" size="0.06 0.06 0.02"/></body></worldbody></mujoco>"""
    found = measure_model(mujoco.MjModel.from_xml_string(xml))
    pull = 9.81 * (np.sin(angle) - friction * np.cos(angle))
    if pull < 0.0:
        assert found.drift_m < 1e-3
        assert found.at_rest
    else:
        assert found.drift_m == pytest.approx(0.5 * pull * 25.0, rel=0.03)
        assert (found.moved, found.fell, found.at_rest) == (("slider",), ("slider",), False)


def test_a_foreign_scene_of_many_files(tmp_path: Path) -> None:
    """Includes, folders of meshes, degrees in another order, nested bodies of several geoms: two touch by 2 mm."""
    (tmp_path / "parts" / "meshes").mkdir(parents=True)
    (tmp_path / "parts" / "meshes" / "cube.obj").write_bytes(obj(trimesh.creation.box((1, 1, 1))))
    (tmp_path / "parts" / "assets.xml").write_text(
        "<mujocoinclude><asset><mesh name='cube' file='cube.obj' scale='0.04 0.04 0.04'/></asset></mujocoinclude>"
    )
    (tmp_path / "scene.xml").write_text(
        """<mujoco><compiler meshdir="parts/meshes" eulerseq="zyx" angle="degree"/>
        <option gravity="0 0 0"/><include file="parts/assets.xml"/><worldbody>
        <body name="tree" pos="0 0 0.5" euler="90 0 0"><freejoint/>
          <geom type="box" size="0.02 0.02 0.02"/>
          <body name="branch" pos="0.1 0 0"><geom type="capsule" size="0.01 0.03"/>
            <body pos="0.1 0 0" euler="0 45 0"><joint type="hinge"/><geom type="mesh" mesh="cube"/></body></body></body>
        <body name="stone" pos="0 0.258284271 0.5"><freejoint/><geom type="box" size="0.1 0.032 0.1"/></body>
        </worldbody></mujoco>"""
    )
    found = measure_model(mujoco.MjModel.from_xml_path(str(tmp_path / "scene.xml")))
    assert found.bodies == ("tree", "stone")
    edge = 0.2 + 0.02 * np.sqrt(2.0)  # the cube's edge, turned by 90 degrees about z to lie along y
    depth = edge - (0.258284271 - 0.032)
    assert depth == pytest.approx(0.002, abs=1e-6)
    assert found.meshes[1] == "tree & stone"
    assert found.pieces[0] == pytest.approx(depth, abs=1e-5)
    assert found.meshes[0] == pytest.approx(depth, abs=1e-3)
    assert found.meshes[0] <= depth + 1e-6


def test_the_depths_of_a_sheet_are_the_same_whatever_was_measured_before() -> None:
    # Two faces back to back enclose nothing: what gives them body is there before anything is measured.
    disc = trimesh.creation.cylinder(0.05, 1e-9, sections=64)
    flat = TriangleMesh(disc.vertices * [1.0, 1.0, 0.0], disc.faces.astype(np.int32))
    pin = from_trimesh(trimesh.creation.cylinder(0.004, 0.05))
    box_above = from_trimesh(trimesh.creation.box((0.03, 0.03, 0.02)))
    here = identity_pose()
    poses = [here, replace(here, position=np.array([0.0, 0.0, 0.0103])), replace(here, position=np.array([0.04, 0, 0]))]
    moving = [
        ModelBody(name, (GeomSolid(name, mesh),)) for name, mesh in (("sheet", flat), ("box", box_above), ("pin", pin))
    ]
    still = ModelBody("world", ())
    first = find_deepest_overlaps(moving, poses, still)
    assert find_deepest_overlaps(moving, poses, still) == first
    assert ("sheet", "pin") in [pair[:2] for pair in first]
    assert moving[0].repaired
