"""URDF in the hands of Bullet, Drake and yourdfpy: things weigh, stand and rest as in the scene."""

import json

import numpy as np
import pytest

from tableverse_factory.delivery.formats.extract import extract_scene
from tests.helpers.exported_scenes import exported

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    dest = tmp_path_factory.mktemp("urdf") / "scene"
    extract_scene(exported(), dest, "urdf")
    return dest


@pytest.fixture(scope="module")
def entries(folder):
    return json.loads((folder / "poses.json").read_text())


def test_things_stay_on_the_table_in_bullet(folder, entries):
    """Run with pybullet 3.2.7, as docs/simulators.md says; its margins lift convex meshes by a millimetre."""
    bullet = pytest.importorskip("pybullet", reason="installed where it is tested")
    bullet.connect(bullet.DIRECT)
    bullet.setGravity(0, 0, -9.81)
    bullet.setTimeStep(0.002)
    things = []
    for entry in entries:
        body = bullet.loadURDF(str(folder / entry["urdf"]), useFixedBase=not entry["moves"])
        center = bullet.getDynamicsInfo(body, -1)[3:5]
        start = bullet.multiplyTransforms(entry["position"], entry["quaternion_xyzw"], *center)
        bullet.resetBasePositionAndOrientation(body, *start)
        if entry["moves"]:
            things.append((body, np.array(start[0])))
    for _ in range(1000):
        bullet.stepSimulation()
    moved = [np.linalg.norm(np.array(bullet.getBasePositionAndOrientation(body)[0]) - at) for body, at in things]
    bullet.disconnect()
    assert len(moved) == 3
    assert max(moved) < 0.003


def test_things_stay_on_the_table_in_drake(folder, entries):
    """Run with drake 1.51.1, as docs/simulators.md says; it has no rolling friction, and this scene's can lies."""
    drake = pytest.importorskip("pydrake.all", reason="installed where it is tested")
    builder = drake.DiagramBuilder()
    plant, graph = drake.AddMultibodyPlantSceneGraph(builder, time_step=0.002)
    drake.Parser(builder).AddModels(str(folder / "scene.urdf"))
    plant.Finalize()
    for entry in entries:
        if entry["moves"]:
            body = plant.GetBodyByName(entry["urdf"].removesuffix(".urdf"))
            turn = drake.Quaternion(np.roll(entry["quaternion_xyzw"], 1))
            plant.SetDefaultFloatingBaseBodyPose(body, drake.RigidTransform(turn, entry["position"]))
    diagram = builder.Build()
    simulator = drake.Simulator(diagram)
    state = plant.GetMyContextFromRoot(simulator.get_context())
    model = exported().model()
    names = ("obj_000", "obj_001", "obj_002")
    bodies = [plant.GetBodyByName(name) for name in names]
    assert len(plant.GetFloatingBaseBodies()) == 3
    for name, body in zip(names, bodies, strict=True):
        assert body.get_mass(state) == pytest.approx(model.body(name).mass[0])
        pose = plant.EvalBodyPoseInWorld(state, body)
        np.testing.assert_allclose(pose.translation(), model.body(name).pos, atol=1e-9)
        center = body.CalcSpatialInertiaInBodyFrame(state).get_com()
        np.testing.assert_allclose(center, model.body(name).ipos, atol=1e-9)
        (shape,) = plant.GetCollisionGeometriesForBody(body)
        friction = graph.model_inspector().GetProximityProperties(shape).GetProperty("material", "coulomb_friction")
        assert friction.static_friction() == pytest.approx(model.geom(f"{name}_piece_00").friction[0])
    start = [plant.EvalBodyPoseInWorld(state, body).translation() for body in bodies]
    simulator.AdvanceTo(2.0)
    moved = [np.linalg.norm(plant.EvalBodyPoseInWorld(state, body).translation() - at)
             for body, at in zip(bodies, start, strict=True)]  # fmt: skip
    assert max(moved[0], moved[2]) < 1e-3
    assert moved[1] < 0.02


def test_yourdfpy_shows_every_thing_where_it_stands(folder, entries):
    """Run with yourdfpy 0.0.60."""
    yourdfpy = pytest.importorskip("yourdfpy", reason="installed where it is tested")
    robot = yourdfpy.URDF.load(str(folder / "scene.urdf"), load_collision_meshes=True)
    assert robot.validate()
    for entry in entries:
        link = entry["urdf"].removesuffix(".urdf")
        found = robot.get_transform(link, "world")
        np.testing.assert_allclose(found[:3, 3], entry["position"], atol=1e-9)
    assert len(robot.scene.geometry) == 4
