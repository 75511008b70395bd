"""Scenes in robosuite: the example of docs/simulators.md, whose things rest, are seen, and are known to robosuite."""

import xml.etree.ElementTree as ET

import numpy as np
import pytest

from tableverse_factory import add_to_robosuite, find_unfit_settings
from tableverse_factory.core.errors import ConfigError, InputError
from tableverse_factory.dataset.scene import Scene
from tests.helpers.docs_pages import run_example
from tests.helpers.exported_scenes import exported

THINGS = ("obj_000", "obj_001", "obj_002")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_the_documented_environment_resets_steps_and_rests(tmp_path, monkeypatch):
    """Run with robosuite 1.5.1 and MuJoCo 3.9."""
    pytest.importorskip("robosuite", reason="installed where it is tested, with an older MuJoCo")
    monkeypatch.chdir(tmp_path)
    scene = exported()
    env = run_example("simulators.md", "add_to_robosuite", scene=scene)["env"]
    written = {body.attrib["name"]: body for body in ET.fromstring(scene.xml).iter("body")}
    for _ in range(2):  # the second time with other files where its own should be
        seen = env.reset()
        model = env.sim.model._model
        assert find_unfit_settings(model) == ()
        assert set(env.things) == {"table", *THINGS}
        for name in THINGS:
            body = model.body(env.things[name].root_body)
            assert body.mass == pytest.approx(float(written[name].find("inertial").attrib["mass"]))
            x, y, z = map(float, written[name].attrib["pos"].split())
            np.testing.assert_allclose(body.pos, (y, -x, z + 0.8), atol=1e-9, err_msg="near edge towards the arm")
        next(tmp_path.rglob("obj_000_piece_00.obj")).write_bytes(b"of an earlier dataset")
    assert seen["object-state"].shape == (7 * len(THINGS),)
    start = {name: seen[f"{name}_pos"] for name in THINGS}
    for _ in range(env.control_freq):
        seen, *_ = env.step(np.zeros(env.action_dim))
    for name in THINGS:
        np.testing.assert_allclose(seen[f"{name}_pos"], start[name], atol=1e-5)
        assert env.check_contact(env.things[name], env.things["table"])
    known = set(env.model.geom_ids_to_instances.values())
    assert {"table", *THINGS} < known, "segmentation of instances"


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_two_scenes_stand_in_one_task_with_a_prefix_each(tmp_path):
    pytest.importorskip("robosuite", reason="installed where it is tested, with an older MuJoCo")
    from robosuite.models.arenas import EmptyArena
    from robosuite.models.robots import Panda
    from robosuite.models.tasks import ManipulationTask

    task = ManipulationTask(EmptyArena(), [Panda()])
    left = add_to_robosuite(task, exported("left"), tmp_path, (0.0, -2.0, 0.8), prefix="left/")
    with pytest.raises(ConfigError, match="prefix 'left/': the task has a body called left/obj_000_main already"):
        add_to_robosuite(task, exported("right"), tmp_path, (0.0, 2.0, 0.8), prefix="left/")
    right = add_to_robosuite(task, exported("right"), tmp_path, (0.0, 2.0, 0.8))
    assert set(left) == set(right) == {"table", *THINGS}
    model = task.get_model()
    for name in THINGS:
        assert (left[name].name, right[name].name) == (f"left/{name}", name)
        apart = model.body(right[name].root_body).pos - model.body(left[name].root_body).pos
        np.testing.assert_allclose(apart, (0.0, 4.0, 0.0), atol=1e-9)
    assert model.nmesh >= 2 * len(THINGS)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    ("own", "foreign", "message"),
    [
        ('"obj_000.png"', '"../../own.png"', r"names '\.\./\.\./own\.png', which is none of its files"),
        ('body name="obj_000"', 'body name="../../obj_000"', "cannot be a file"),
        ('body name="obj_000"', "body", "cannot be a file"),
        ('default class="visual"', 'default class="seen"', "has the class 'seen'"),
    ],
)
def test_a_foreign_scene_is_refused_before_anything_is_written(tmp_path, own, foreign, message):
    pytest.importorskip("robosuite", reason="installed where it is tested, with an older MuJoCo")
    scene = exported()
    files = scene.files() | {"scene.xml": scene.xml.replace(own, foreign).encode()}
    with pytest.raises(InputError, match=message):
        add_to_robosuite(None, Scene(scene.scene_id, {}, files), tmp_path / "a/b/made")
    assert not list(tmp_path.iterdir())
