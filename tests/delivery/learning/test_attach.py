"""Scenes in other models: settings that let them rest come along, names do not clash, and a check says what lacks."""

import mujoco
import numpy as np
import pytest

from tableverse_factory import attach_scene, attach_to_dm_control, find_unfit_settings, open_dataset
from tableverse_factory.core.errors import ConfigError
from tableverse_factory.physics.simulate.at_rest import find_free_bodies, measure_drift, read_body_poses


@pytest.fixture(scope="module")
def scene(out):
    return open_dataset(out).scene("s-1")


@pytest.fixture
def room() -> mujoco.MjSpec:
    """A model with MuJoCo's defaults, a sky and a lamp of its own."""
    return mujoco.MjSpec.from_string(
        """<mujoco><asset><texture name="sky" type="skybox" builtin="flat" width="8" height="8"/></asset>
        <worldbody><light name="lamp" pos="0 0 3"/><geom type="plane" size="2 2 1"/></worldbody></mujoco>"""
    )


def test_an_attached_scene_rests_as_it_does_alone(scene, room):
    attach_scene(room, scene, (1.0, -2.0, 0.7), 0.5)
    model, alone = room.compile(), scene.model()
    assert find_unfit_settings(model) == find_unfit_settings(alone) == ()
    for name in ("timestep", "integrator", "cone", "impratio", "noslip_iterations", "disableflags"):
        assert getattr(model.opt, name) == getattr(alone.opt, name)
    assert model.nlight == 1
    assert model.vis.headlight.ambient[0] == pytest.approx(0.1), "how the parent looks is its own"
    assert sum(model.tex_type == mujoco.mjtTexture.mjTEXTURE_SKYBOX) == 1
    assert measure_drift(model, 1.0).distance_m.max() < 1e-5
    turn = np.array([[np.cos(0.5), -np.sin(0.5), 0.0], [np.sin(0.5), np.cos(0.5), 0.0], [0.0, 0.0, 1.0]])
    ours = read_body_poses(alone, mujoco.MjData(alone), find_free_bodies(alone))
    theirs = read_body_poses(model, mujoco.MjData(model), find_free_bodies(model))
    for a, b in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(b.position, turn @ a.position + [1.0, -2.0, 0.7], atol=1e-9)


def test_what_the_scenes_need_is_found_lacking(room):
    room.option.timestep = 0.005
    room.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_MULTICCD
    found = find_unfit_settings(room.compile())
    assert [line.split(" is ")[0] for line in found] == [
        *("integrator", "cone", "impratio", "noslip_iterations", "timestep", "multiccd"),
    ]
    assert "impratio is 1; scenes rest with 100" in found
    assert "timestep is 0.005 s; contacts are stable up to 0.002 s" in found


def test_a_shorter_timestep_stays_and_a_longer_one_does_not(scene, room):
    for own, expected in ((0.001, 0.001), (0.01, 0.002)):
        parent = room.copy()
        parent.option.timestep = own
        attach_scene(parent, scene)
        assert parent.compile().opt.timestep == expected


def test_two_scenes_need_two_prefixes(scene, room):
    attach_scene(room, scene, prefix="a/", visuals=False)
    with pytest.raises(ConfigError, match="prefix 'a/': the model has a scene of this prefix already"):
        attach_scene(room, scene, (3.0, 0.0, 0.0), prefix="a/")
    attach_scene(room, scene, (3.0, 0.0, 0.0), prefix="b/", visuals=False)
    model = room.compile()
    assert {"a/table", "b/table", "a/obj_000", "b/obj_002"} <= {model.body(k).name for k in range(model.nbody)}


@pytest.mark.slow
def test_dm_control_takes_a_scene_into_its_arena(scene):
    """Run with dm_control 1.0.50 and MuJoCo 3.17."""
    composer = pytest.importorskip("dm_control.composer", reason="dm_control is installed where it is tested")
    from dm_control import mjcf

    arena = composer.Arena()
    frames = attach_to_dm_control(arena.mjcf_model, scene, prefix="scene_")
    assert set(frames) == {"table", "obj_000", "obj_001", "obj_002"}
    model, alone = mjcf.Physics.from_mjcf_model(arena.mjcf_model).model.ptr, scene.model()
    assert find_unfit_settings(model) == ()
    assert model.nq == alone.nq
    for name in ("obj_000", "obj_001", "obj_002"):
        assert model.body(f"scene_{name}/").mass == pytest.approx(alone.body(name).mass)
        np.testing.assert_allclose(model.body(f"scene_{name}/").pos, alone.body(name).pos, atol=1e-9)
    assert measure_drift(model, 1.0).distance_m.max() < 1e-5
