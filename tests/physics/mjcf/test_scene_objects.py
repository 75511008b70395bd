"""An exported scene read back as things: the same shapes, poses and table as the simulator has."""

import os
import signal

import mujoco
import numpy as np
import pytest

from schemas.config import Config
from schemas.outcome import Done
from tableverse_factory.core.errors import GeometryError, InputError
from tableverse_factory.geometry.math.transforms import rotation_matrix
from tableverse_factory.models.services import Services
from tableverse_factory.physics.mjcf.load import load_model
from tableverse_factory.physics.mjcf.scene_objects import load_scene_objects, read_slab
from tableverse_factory.stages.export.export import export
from tests.helpers.simple_scenes import Solid, as_settled, ball, box, curated, layout


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    turned = (np.cos(0.3), 0.0, 0.0, np.sin(0.3))
    solids = [
        Solid(box(0.1, 0.05, 0.04), (0.0, 0.02, 0.02), quaternion=turned),
        Solid(box(0.06, 0.06, 0.06), (0.29, -0.1, 0.03)),  # at the edge: the slab is wider than the table
        Solid(ball(0.03), (-0.15, 0.0, 0.0297)),
    ]
    services = Services(tmp_path_factory.mktemp("cache"))
    outcome = export(curated(as_settled(layout(solids))), Config(), np.random.default_rng(0), services)
    assert isinstance(outcome, Done), outcome
    return outcome.value


def test_things_stand_where_the_simulator_has_them(scene):
    files = dict(scene.files)
    model = load_model(files)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    things = load_scene_objects(files, scene.object_rows)
    assert list(things) == [row["object_id"] for row in scene.object_rows]
    for name, thing in things.items():
        np.testing.assert_allclose(thing.pose.position, data.body(name).xpos, atol=1e-9)
        np.testing.assert_allclose(
            rotation_matrix(thing.pose.quaternion_wxyz), data.body(name).xmat.reshape(3, 3), atol=1e-9
        )
        assert thing.mass_kg == pytest.approx(float(model.body(name).mass[0]))
        geoms = [g for g in range(model.ngeom) if model.body(model.geom_bodyid[g]).name == name]
        assert len(thing.hulls) == sum(model.geom_contype[g] > 0 for g in geoms)
        np.testing.assert_allclose(thing.body.low, thing.standing.vertices.min(axis=0))


def test_the_slab_is_the_table_of_the_file(scene):
    files = dict(scene.files)
    slab, model = read_slab(files), load_model(files)
    np.testing.assert_allclose(slab.half_size_xy, model.geom("table").size[:2])
    np.testing.assert_allclose(slab.center_xy, model.body("table").pos[:2])
    assert all(
        slab.holds(thing.standing.vertices).all() for thing in load_scene_objects(files, scene.object_rows).values()
    )


@pytest.mark.parametrize(
    "change", [{"x_m": None}, {"qw": float("nan")}, {"n_pieces": 10**9}, {"mass_kg": float("inf")}]
)
def test_rows_that_are_no_rows_are_refused(scene, change):
    with pytest.raises(InputError):
        load_scene_objects(dict(scene.files), [{**scene.object_rows[0], **change}])


def test_files_that_are_missing_or_no_meshes_are_refused(scene):
    files, row = dict(scene.files), scene.object_rows[0]
    name = f"assets/{row['object_id']}.obj"
    with pytest.raises(InputError, match="there is no"):
        load_scene_objects({k: v for k, v in files.items() if k != name}, [row])
    with pytest.raises(GeometryError):
        load_scene_objects({**files, name: b"v nan 0 0\nf 1 1 1\n"}, [row])
    for xml in (b"", b"<mujoco/>", b"\xff", b"<mujoco><worldbody><body name='table'/></worldbody></mujoco>"):
        with pytest.raises(InputError):
            read_slab({"scene.xml": xml})


@pytest.mark.parametrize(
    "names",
    [
        "<include file='{}'/>",
        "<asset><mesh name='m' file='{}'/></asset>",
        "<compiler meshdir='/etc'/>",
        "<asset><texture name='t' type='2d' file='{}'/></asset>",
    ],
)
def test_nothing_outside_a_scene_is_opened(scene, tmp_path, names):
    """A FIFO, because to open one without a writer would hang for ever; by its absolute path, and by a way up to it."""
    fifo = tmp_path / "fifo.xml"
    os.mkfifo(fifo)
    files = dict(scene.files)
    for named in (str(fifo), os.path.relpath(fifo), "file:" + str(fifo)):
        added = names.format(named).encode()
        hostile = files["scene.xml"].replace(b"<worldbody>", added + b"<worldbody>", 1)
        signal.alarm(10)
        try:
            with pytest.raises(InputError, match="which is none of its files"):
                read_slab({**files, "scene.xml": hostile})
        finally:
            signal.alarm(0)
