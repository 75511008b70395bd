"""Different scenes in one batch: each world holds its scene, whatever the others hold, and rests as in MuJoCo."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from tableverse_factory import open_dataset
from tableverse_factory.core.errors import ConfigError, InputError
from tableverse_factory.dataset.dataset import Scene
from tableverse_factory.delivery.learning.warp import WarpBatch
from tableverse_factory.delivery.learning.warp_template import build_template
from tests.helpers.exported_scenes import exported


@pytest.fixture(scope="module")
def scenes(out) -> list[Scene]:
    """Two tables of blocks and one with things of other shapes."""
    dataset = open_dataset(out)
    return [dataset.scene("s-0"), dataset.scene("s-3"), exported("odd")]


def test_the_template_has_room_for_each_scene_and_its_shapes(scenes):
    template = build_template(scenes)
    model = template.model
    assert [len(one.objects) for one in template.scenes] == [3, 3, 3]
    assert model.nv == 18
    for one, arrays in zip(template.scenes, template.worlds, strict=True):
        for slot, (body, geoms) in enumerate(one.objects):
            assert arrays["body_mass"][2 + slot] == one.model.body_mass[body]
            first = int(model.body_geomadr[2 + slot])
            for geom, source in enumerate(geoms, first):
                mine, theirs = int(arrays["geom_dataid"][geom]), int(one.model.geom_dataid[source])
                np.testing.assert_array_equal(_vertices(model, mine), _vertices(one.model, theirs))
            rest = arrays["geom_dataid"][first + len(geoms) : first + int(model.body_geomnum[2 + slot])]
            assert (rest == -1).all()
        assert arrays["body_gravcomp"][2 : 2 + len(one.objects)].max() == 0.0


def _vertices(model: mujoco.MjModel, mesh: int) -> np.ndarray:
    return model.mesh_vert[model.mesh_vertadr[mesh] :][: model.mesh_vertnum[mesh]]


def test_scenes_that_do_not_fit_into_a_batch_are_refused(scenes):
    def changed(scene: Scene, old: str, new: str) -> Scene:
        files = {**scene.files(), "scene.xml": scene.xml.replace(old, new).encode()}
        return replace(scene, _files=files)

    with pytest.raises(InputError, match="s-3 has another timestep than the first"):
        build_template([scenes[0], changed(scenes[1], "<option ", '<option timestep="0.001" ')])
    pillar = '<worldbody><geom name="pillar" type="sphere" size="0.1"/>'
    with pytest.raises(InputError, match="s-0: a batch takes a table that is a box"):
        build_template([changed(scenes[0], "<worldbody>", pillar)])
    with pytest.raises(ConfigError, match="no scenes"):
        WarpBatch([])


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_worlds_of_warp_rest_reset_and_read_back(scenes):
    """Run with mujoco-warp 4.0.0 on Warp's CPU backend, which compiles for a minute."""
    pytest.importorskip("mujoco_warp", reason="installed where it is tested")
    batch = WarpBatch([*scenes, scenes[0]], device="cpu")
    start = batch.poses()
    assert start.shape == (4, 3, 7)
    for world, model in enumerate(batch.models):
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        assert (batch.data.contact.worldid.numpy()[: batch.data.nacon.numpy()[0]] == world).sum() == data.ncon
        for slot, name in enumerate(batch.object_ids[world]):
            np.testing.assert_allclose(start[world, slot, :3], model.body(name).pos, atol=1e-6)
    batch.step(250)
    assert np.abs(batch.poses() - start)[..., :3].max() < 1e-4
    assert not batch.overflowed().any()
    position = batch.data.qpos.numpy()
    position[:, 2] += 0.05
    batch.data.qpos.assign(position)
    batch.reset(np.array([True, False, False, True]))
    back = np.abs(batch.poses() - start)[:, 0, 2]
    assert back[[0, 3]].max() < 1e-6
    assert back[[1, 2]].min() > 0.04
    with pytest.raises(ConfigError, match="give one truth value for each of 4"):
        batch.reset(np.array([True]))
    tight = WarpBatch(scenes[:1], njmax=6, device="cpu")
    tight.step(1)
    assert tight.overflowed().all()
