"""Anybody's MJCF as objects: primitives, articulated things, scenes in which nothing moves."""

import mujoco
import numpy as np
import pytest

from tableverse_factory.delivery.formats.model_contents import is_table, read_model_contents
from tableverse_factory.geometry.mesh.mass_integrals import compute_signed_volume
from tableverse_factory.geometry.mesh.meshes import place_mesh

LAPTOP = """<mujoco><compiler angle="radian"/><worldbody>
  <geom name="floor" type="plane" size="0 0 1"/>
  <body name="laptop" pos="0.1 0.2 0.3" quat="0.9 0.1 0.2 0.3"><freejoint/>
    <geom type="box" size="0.1 0.08 0.01" mass="1.1" friction="0.6 0.01 0.01"/>
    <body pos="0 0.08 0.01" euler="0.7 0 0"><joint type="hinge" axis="1 0 0"/>
      <geom type="box" size="0.1 0.005 0.08" pos="0 0 0.08" mass="0.5"/>
      <geom type="sphere" size="0.01" pos="0.05 0 0.1" mass="0.1" contype="0" conaffinity="0" rgba="1 0 0 1"/></body>
  </body>
  <body name="ball" pos="1 0 0.05"><freejoint/><geom type="sphere" size="0.05" mass="0.2"/></body>
</worldbody></mujoco>"""


@pytest.fixture(scope="module")
def laptop() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(LAPTOP)


def test_what_hangs_on_a_body_weighs_with_it(laptop):
    data = mujoco.MjData(laptop)
    mujoco.mj_forward(laptop, data)
    contents = read_model_contents(laptop)
    assert [content.name for content in contents.objects] == ["laptop", "ball"]
    thing, body = contents.objects[0], laptop.body("laptop").id
    assert thing.mass_kg == pytest.approx(laptop.body_subtreemass[body])
    turn = data.xmat[body].reshape(3, 3)
    np.testing.assert_allclose(turn @ thing.center + data.xpos[body], data.subtree_com[body], atol=1e-12)
    np.testing.assert_allclose(turn @ thing.inertia @ turn.T, _about_center(laptop, data, body), atol=1e-12)
    assert thing.friction == 1.0


def _about_center(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> np.ndarray:
    """MuJoCo's own composite inertia about the tree's centre: xx, yy, zz, xy, xz, yz in the world's axes."""
    xx, yy, zz, xy, xz, yz = data.crb[body][:6]
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def test_what_is_seen_and_what_collides(laptop):
    thing, ball = read_model_contents(laptop).objects
    assert len(thing.hulls) == 2
    assert len(thing.looks) == 3
    assert thing.looks[2].color == (255, 0, 0), "what does not collide is seen beside what does"
    assert compute_signed_volume(thing.hulls[0]) == pytest.approx(0.2 * 0.16 * 0.02)
    assert compute_signed_volume(ball.hulls[0]) == pytest.approx(4 / 3 * np.pi * 0.05**3, rel=0.01)
    standing = place_mesh(ball.looks[0].mesh, ball.pose)
    np.testing.assert_allclose(standing.vertices.mean(axis=0), [1, 0, 0.05], atol=1e-6)


def test_only_what_the_viewer_hides_is_not_seen():
    """Groups 3 and above are hidden: there our own scenes, and most others', keep what only collides."""
    geoms = '<geom type="box" size="0.1 0.1 0.1" group="{}"/><geom type="sphere" size="0.1" contype="0" conaffinity="0"'
    geoms = geoms + ' group="{}"/>'
    counts = []
    for groups in ((3, 2), (0, 1), (1, 0), (3, 3), (4, 5)):
        body = f'<body name="a"><freejoint/>{geoms.format(*groups)}</body>'
        model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
        (thing,) = read_model_contents(model).objects
        counts.append(len(thing.looks))
        assert len(thing.hulls) == 1
    assert counts == [1, 2, 2, 2, 2]


def test_a_plane_is_seen_and_is_no_collider_of_its_own(laptop):
    (floor,) = read_model_contents(laptop).still
    assert floor.hulls == ()
    assert len(floor.looks) == 1


def test_where_nothing_moves_everything_but_the_table_is_an_object():
    bodies = "".join(
        f'<body name="{name}" pos="{x} 0 0"><geom type="box" size=".1 .1 .1"/></body>'
        for x, name in enumerate(("Table", "mug", "bowl"))
    )
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
    contents = read_model_contents(model)
    assert [content.name for content in contents.objects] == ["mug", "bowl"]
    assert [content.name for content in contents.still] == ["Table"]


@pytest.mark.parametrize(("name", "table"), [("table", True), (" Desk ", True), ("tablet", False), ("obj_000", False)])
def test_names_of_tables(name, table):
    assert is_table(name) is table
