"""Scenes in SAPIEN and ManiSkill: the same bodies, which stay where they stand."""

import numpy as np
import pytest

from tableverse_factory.delivery.learning.sapien import add_to_sapien
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
