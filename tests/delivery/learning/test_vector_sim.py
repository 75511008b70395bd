"""Many scenes at once: each moves as it would alone, whatever stands beside it, and whoever steps it."""

import time
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from tableverse_factory import VectorSim, build_scene_grid, open_dataset
from tableverse_factory.core.errors import ConfigError, InputError


@pytest.fixture(scope="module")
def scenes(out):
    dataset = open_dataset(out)
    return [dataset.scene(f"s-{k}") for k in range(4)]


def kicked(model, data):
    """Pushes every object, so that there is something to simulate."""
    data.qvel[:] = np.random.default_rng(3).uniform(-0.4, 0.4, model.nv)


@pytest.mark.parametrize("threads", [1, 3])
def test_threads_step_each_model_as_it_steps_alone(scenes, threads):
    with VectorSim(scenes, threads) as many:
        assert many.scene_ids == ("s-0", "s-1", "s-2", "s-3")
        many.step(control=lambda number, model, data: kicked(model, data))
        for _ in range(3):
            many.step(20)
        for scene, data in zip(scenes, many.data, strict=True):
            alone = scene.model()
            own = mujoco.MjData(alone)
            kicked(alone, own)
            mujoco.mj_step(alone, own, nstep=61)
            assert np.array_equal(own.qpos, data.qpos)
            assert np.abs(own.qpos - alone.qpos0).max() > 0.005
    with pytest.raises(RuntimeError):
        many.step()


def test_where_one_scene_fails_the_others_are_stepped_before_it_is_said(scenes):
    def control(number, model, data):
        if number == 0:
            raise ArithmeticError("no force for this one")
        time.sleep(0.05)

    with VectorSim(scenes, 2) as many:
        with pytest.raises(ArithmeticError, match="no force"):
            many.step(control=control)
        assert [data.time > 0 for data in many.data] == [False, True, True, True]


def test_what_only_is_seen_is_left_out_unless_asked_for(scenes):
    with VectorSim(scenes[:1], 1) as plain, VectorSim(scenes[:1], 1, visuals=True) as seen:
        assert plain.models[0].nmesh < seen.models[0].nmesh
        assert np.array_equal(plain.models[0].body_mass, seen.models[0].body_mass)


def test_a_grid_holds_every_scene_at_its_place_under_its_prefix(scenes):
    grid = build_scene_grid(scenes)
    data = mujoco.MjData(grid.model)
    assert grid.prefixes == ("s00/", "s01/", "s02/", "s03/")
    for k, scene in enumerate(scenes):
        alone = scene.model()
        assert grid.object_ids(k) == ("obj_000", "obj_001", "obj_002")
        assert np.abs(grid.poses(data, k) - alone.qpos0.reshape(-1, 7)).max() < 1e-9
        assert grid.model.body(f"s0{k}/obj_000").mass == pytest.approx(alone.body("obj_000").mass)
    for name in ("timestep", "integrator", "cone", "impratio", "noslip_iterations", "enableflags"):
        assert getattr(grid.model.opt, name) == getattr(alone.opt, name)
    tables = np.array([grid.model.body(f"{prefix}table").pos for prefix in grid.prefixes])
    apart = np.linalg.norm(tables[:, None] - tables[None], axis=2)[np.triu_indices(4, 1)]
    assert apart.min() > 2 * np.linalg.norm(grid.model.geom("s00/table").size[:2])


def test_in_a_grid_scenes_move_as_they_do_alone(scenes):
    grid = build_scene_grid(scenes)
    data = mujoco.MjData(grid.model)
    for k, scene in enumerate(scenes):
        alone = scene.model()
        own = mujoco.MjData(alone)
        kicked(alone, own)
        starts = [grid.model.joint(int(grid.model.body(f"s0{k}/{name}").jntadr[0])) for name in grid.object_ids(k)]
        for joint, velocity in zip(starts, own.qvel.reshape(-1, 6), strict=True):
            data.qvel[joint.dofadr[0] : joint.dofadr[0] + 6] = velocity
        mujoco.mj_step(alone, own, nstep=100)
        scenes_end = own.qpos.reshape(-1, 7)
        fresh = mujoco.MjData(grid.model)
        fresh.qvel[:] = data.qvel
        mujoco.mj_step(grid.model, fresh, nstep=100)
        assert np.abs(grid.poses(fresh, k) - scenes_end).max() < 1e-4
        assert np.abs(scenes_end - alone.qpos0.reshape(-1, 7)).max() > 0.005


def test_scenes_touch_only_themselves_even_where_they_stand_in_one_another(scenes):
    grid = build_scene_grid(scenes, spacing_m=0.01)
    data = mujoco.MjData(grid.model)
    mujoco.mj_step(grid.model, data, nstep=50)
    pairs = grid.model.geom_bodyid[data.contact.geom]
    assert len(pairs) > 20
    prefixes = [{grid.model.body(int(body)).name.split("/")[0] for body in pair} for pair in pairs]
    assert all(len(both) == 1 for both in prefixes)
    for k, scene in enumerate(scenes):
        assert np.abs(grid.poses(data, k) - scene.model().qpos0.reshape(-1, 7)).max() < 1e-3, "nothing was pushed away"


def test_a_spacing_that_is_none_or_too_small_for_so_many_is_refused(scenes):
    for wrong in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(ConfigError, match="give a length above 0 m, or None"):
            build_scene_grid(scenes, spacing_m=wrong)
    with pytest.raises(ConfigError, match=r"32 scenes would touch one another; give 0\.91 m or more, or at most 31"):
        build_scene_grid(scenes * 8, spacing_m=0.01)
    grid = build_scene_grid(scenes * 8, spacing_m=0.91)
    data = mujoco.MjData(grid.model)
    mujoco.mj_step(grid.model, data)
    pairs = grid.model.geom_bodyid[data.contact.geom]
    assert len(pairs) > 32
    assert all(len({grid.model.body(int(body)).name.split("/")[0] for body in pair}) == 1 for pair in pairs)


def test_a_grid_is_seen(scenes):
    grid = build_scene_grid(scenes, visuals=True)
    data = mujoco.MjData(grid.model)
    mujoco.mj_forward(grid.model, data)
    picture = grid.picture(data, 320, 200)
    assert picture.shape == (200, 320, 3)
    background = (picture == picture[0, 0]).all(axis=2)
    assert 0.03 < 1 - background.mean() < 0.9
    assert len(np.unique(picture[~background], axis=0)) > 50


def test_what_does_not_fit_is_said(scenes):
    files = {**scenes[1].files(), "scene.xml": scenes[1].xml.replace("<option ", '<option timestep="0.001" ').encode()}
    with pytest.raises(InputError, match=r"scene s-1 has a timestep of 0.001 s, and the first one has 0.002 s"):
        build_scene_grid([scenes[0], replace(scenes[1], _files=files)])
    with pytest.raises(InputError, match=r"scene s-1: there is no scene.xml"):
        VectorSim([scenes[0], replace(scenes[1], _files={})])
    with pytest.raises(ConfigError, match="no scenes"):
        build_scene_grid([])
    with pytest.raises(ConfigError, match="0 scenes on 2 threads"):
        VectorSim([], 2)
