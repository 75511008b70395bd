"""Scenes for MJX: few colliders, the same masses, no collisions, and what does not fit is refused."""

import mujoco
import numpy as np
import pytest

from tableverse_factory.core.errors import InputError
from tableverse_factory.delivery.learning.mjx import DEPTH_M, count_mjx_contacts, load_mjx_spec
from tests.helpers.exported_scenes import exported


def test_each_thing_has_one_hull_where_that_fits():
    scene = exported()
    model, full = load_mjx_spec(scene).compile(), scene.model()
    assert model.ngeom == 4
    assert model.opt.noslip_iterations == 0
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert -data.contact.dist.min(initial=0.0) <= DEPTH_M
    for name in ("obj_000", "obj_001", "obj_002"):
        assert model.body(name).mass == pytest.approx(full.body(name).mass)
        np.testing.assert_allclose(model.body(name).inertia, full.body(name).inertia)


def test_a_scene_of_too_many_contacts_is_refused():
    with pytest.raises(InputError, match="MJX would reserve 24 contacts for 3 colliders, more than 20"):
        load_mjx_spec(exported(), max_contacts=20)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_mjx_reserves_as_many_contacts_as_counted():
    """Run with mujoco-mjx 3.17.0."""
    mjx = pytest.importorskip("mujoco.mjx", reason="installed where it is tested")
    model = load_mjx_spec(exported()).compile()
    mjx.put_model(model)
    assert mjx.make_data(model)._impl.ncon == count_mjx_contacts([1, 1, 1])
