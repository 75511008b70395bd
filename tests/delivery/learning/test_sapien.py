"""Scenes in SAPIEN and ManiSkill: the same bodies, which stay where they stand."""

import numpy as np
import pytest

from tableverse_factory.delivery.learning.sapien import add_to_sapien
from tests.helpers.docs_pages import run_example
from tests.helpers.exported_scenes import exported


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_things_stay_in_sapien():
    """Run with SAPIEN 3.0.3."""
    sapien = pytest.importorskip("sapien", reason="installed where it is tested")
    scene = exported()
    world = sapien.Scene([sapien.physx.PhysxCpuSystem()])
    world.set_timestep(0.002)
    actors = add_to_sapien(world, scene)
    model = scene.model()
    assert set(actors) == {"table", "obj_000", "obj_001", "obj_002"}
    for name in ("obj_000", "obj_001", "obj_002"):
        body = actors[name].find_component_by_type(sapien.physx.PhysxRigidDynamicComponent)
        assert body.mass == pytest.approx(float(model.body(name).mass[0]), rel=1e-5)
        np.testing.assert_allclose(actors[name].pose.p, model.body(name).pos, atol=1e-6)
    for _ in range(500):
        world.step()
    for name in ("obj_000", "obj_002"):  # the can lies, and rolls where nothing brakes it
        np.testing.assert_allclose(actors[name].pose.p, model.body(name).pos, atol=2e-3)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_the_documented_environment_of_maniskill_resets_steps_and_rests():
    """Run with ManiSkill 3.0.1 and SAPIEN 3.0.3."""
    pytest.importorskip("mani_skill", reason="installed where it is tested")
    scene = exported()
    env = run_example("simulators.md", "mani_skill", scene=scene)["env"]
    model, things = scene.model(), env.unwrapped.things
    hold = np.zeros(env.action_space.shape, dtype=np.float32)
    for _ in range(2):
        seen, _ = env.reset(seed=0)
        assert seen.shape == (1, 18 + 7 * len(things)), "joints, their speeds, and poses"
        for name, thing in things.items():
            x, y, z = model.body(name).pos
            np.testing.assert_allclose(thing.pose.p[0], (y, -x, z), atol=1e-6, err_msg="near edge towards the arm")
        for _ in range(2 * env.unwrapped.control_freq):
            env.step(hold)
        for name in ("obj_000", "obj_002"):  # the can lies, and rolls where nothing brakes it
            x, y, z = model.body(name).pos
            np.testing.assert_allclose(things[name].pose.p[0], (y, -x, z), atol=2e-3)
    assert "obj_001" in env.unwrapped.get_state_dict()["actors"]
    more = add_to_sapien(env.unwrapped.scene, scene, (0.0, 0.0, 1.0), prefix="second_")
    assert {thing.name for thing in more.values()} == {f"second_{name}" for name in things}
