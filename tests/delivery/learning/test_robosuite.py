"""Scenes in robosuite: the example of docs/simulators.md, whose things rest, are seen, and are known to robosuite."""

import xml.etree.ElementTree as ET

import numpy as np
import pytest

from tableverse_factory import add_to_robosuite, find_unfit_settings
from tableverse_factory.core.errors import InputError
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
def test_a_scene_that_names_other_files_is_refused(tmp_path):
    pytest.importorskip("robosuite", reason="installed where it is tested, with an older MuJoCo")
    own = exported()
    files = own.files() | {"scene.xml": own.xml.replace('"obj_000.png"', '"../../own.png"').encode()}
    with pytest.raises(InputError, match=r"it names '\.\./\.\./own\.png', which is none of its files"):
        add_to_robosuite(None, Scene(own.scene_id, {}, files), tmp_path / "made")
    assert not (tmp_path / "made").exists()
