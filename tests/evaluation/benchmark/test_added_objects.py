"""Objects of other scenes: added as they are, where they are to stand, and nothing else changes."""

import mujoco
import numpy as np
import pytest

from tableverse_factory.core.errors import InputError
from tableverse_factory.evaluation.benchmark.added_objects import add_objects, move_objects
from tableverse_factory.evaluation.benchmark.benchmark import AddedObject
from tableverse_factory.physics.mjcf.scene_objects import load_scene_objects

pytestmark = pytest.mark.heavy

POSE = (0.3, -0.1, 0.049999, 1.0, 0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def scenes(dataset):
    return dataset.scene("s-0"), dataset.scene("s-1")


@pytest.mark.slow  # compares scenes of all episodes
def test_the_scene_stays_and_the_object_is_that_of_its_own_scene(scenes):
    scene, donor = scenes
    before, theirs = scene.model(), donor.model()
    after = add_objects(scene, [(donor, AddedObject(scene_id="s-1", object_id="obj_002", pose=POSE))]).model()
    for body in range(before.nbody):
        name = before.body(body).name
        assert after.body(name).mass == before.body(body).mass
        assert np.array_equal(after.body(name).pos, before.body(body).pos)
    added, own = after.body("added_0"), theirs.body("obj_002")
    assert (added.mass, *added.inertia, *added.ipos) == (own.mass, *own.inertia, *own.ipos)
    assert tuple(added.pos) + tuple(added.quat) == POSE
    assert len(after.geom_friction[after.geom_bodyid == added.id]) == theirs.body_geomnum[own.id]
    assert np.array_equal(
        after.geom_friction[after.geom_bodyid == added.id], theirs.geom_friction[theirs.geom_bodyid == own.id]
    )


def test_meshes_and_rows_of_the_object_are_found_by_its_new_name(scenes):
    scene, donor = scenes
    one = AddedObject(scene_id="s-1", object_id="obj_002", pose=POSE)
    two = AddedObject(scene_id="s-1", object_id="obj_000", pose=(0.3, 0.2, 0.03, 1.0, 0.0, 0.0, 0.0))
    both = add_objects(scene, [(donor, one), (donor, two)])
    objects = load_scene_objects(both.files(), both.object_rows())
    theirs = load_scene_objects(donor.files(), donor.object_rows())
    for name, old in (("added_0", "obj_002"), ("added_1", "obj_000")):
        assert np.array_equal(objects[name].mesh.vertices, theirs[old].mesh.vertices)
        assert len(objects[name].hulls) == len(theirs[old].hulls)
    assert np.allclose(objects["added_0"].pose.position, POSE[:3])
    assert both.task_rows() == scene.task_rows()


def test_clutter_of_a_benchmark_rests_and_touches_nothing(benchmark, dataset):
    episode = next(e for e in benchmark.episodes if e.perturbation.axis == "clutter")
    added = [(dataset.scene(thing.scene_id), thing) for thing in episode.perturbation.added]
    assert len(added) == 2
    model = add_objects(dataset.scene(episode.scene_id), added).model()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    table, things = model.body("table").id, {model.body(f"added_{k}").id for k in range(2)}
    touching = {tuple(sorted(pair)) for pair in model.geom_bodyid[data.contact.geom].tolist() if things & set(pair)}
    assert touching <= {(table, thing) for thing in things}
    before = data.xpos.copy()
    mujoco.mj_step(model, data, nstep=500)
    assert np.linalg.norm(data.xpos - before, axis=1).max() < 1e-3


def test_moved_objects_stand_where_they_are_put(scenes):
    scene, _ = scenes
    pose = np.array([-0.1, 0.05, 0.03, np.cos(0.3), 0.0, 0.0, np.sin(0.3)])
    moved = move_objects(scene, {"obj_000": pose})
    assert np.array_equal(moved.model().qpos0[:7], pose)
    row = next(row for row in moved.object_rows() if row["object_id"] == "obj_000")
    assert [row[name] for name in ("x_m", "y_m", "z_m", "qw", "qx", "qy", "qz")] == pose.tolist()
    with pytest.raises(InputError, match="has no object 'obj_9'"):
        move_objects(scene, {"obj_9": pose})


def test_what_does_not_fit_is_refused(scenes):
    scene, donor = scenes
    with pytest.raises(InputError, match="has no body 'obj_9'"):
        add_objects(scene, [(donor, AddedObject(scene_id="s-1", object_id="obj_9", pose=POSE))])
    once = add_objects(scene, [(donor, AddedObject(scene_id="s-1", object_id="obj_002", pose=POSE))])
    with pytest.raises(InputError, match="a body 'added_0' already"):
        add_objects(once, [(donor, AddedObject(scene_id="s-1", object_id="obj_002", pose=POSE))])
    files = donor.files()
    files["scene.xml"] = files["scene.xml"].replace(b'solref="0.004 1"', b'solref="0.02 1"')
    soft = type(donor)(donor.scene_id, donor.row, files, donor._rows)
    with pytest.raises(InputError, match="its <default> is not that of the scene"):
        add_objects(scene, [(soft, AddedObject(scene_id="s-1", object_id="obj_002", pose=POSE))])
