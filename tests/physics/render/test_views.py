"""Scenery from models, and the views that frame it."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
import trimesh
from PIL import ImageColor

from schemas.geometry import Camera, Texture, TriangleMesh
from tableverse_factory.geometry.mesh.meshes import from_trimesh
from tableverse_factory.physics.mjcf.obj_assets import encode_obj, scale_and_quantize
from tableverse_factory.physics.mjcf.scenery import load_scenery, make_box_mesh, make_scenery
from tableverse_factory.physics.mjcf.slab import Slab
from tableverse_factory.physics.render.preview import PreviewRenderer
from tableverse_factory.physics.render.views import (
    BOX_COLORS,
    draw_boxes,
    draw_judge_sheet,
    make_front_camera,
    make_top_camera,
    render_pictures,
    resize_camera,
)
from tableverse_factory.stages.export.texture import bake_texture

SLAB = Slab(np.array([0.1, 0.0]), np.array([0.5, 0.3]), 0.4, (180, 150, 120))


def ball(x: float, y: float, radius: float = 0.04) -> TriangleMesh:
    solid = trimesh.creation.icosphere(2, radius)
    solid.apply_translation([x, y, radius])
    return from_trimesh(solid)


def moved_box(x: float) -> TriangleMesh:
    return from_trimesh(trimesh.creation.box((0.1, 0.1, 0.1), trimesh.transformations.translation_matrix((x, 0, 0.05))))


def test_a_texture_comes_back_as_the_colours_it_was_made_of():
    """Through our OBJ and PNG, and MuJoCo's own ideas of where v starts."""
    mesh = from_trimesh(trimesh.creation.box((0.1, 0.2, 0.3)))
    rng = np.random.default_rng(0)
    corners = TriangleMesh(
        mesh.vertices[mesh.faces.reshape(-1)],
        np.arange(3 * len(mesh.faces), dtype=np.int32).reshape(-1, 3),
        np.repeat(rng.integers(0, 255, (len(mesh.faces), 3), dtype=np.uint8), 3, axis=0),
    )
    appearance = bake_texture(corners)
    xml = """<mujoco><asset><mesh name="m" file="m.obj" inertia="shell"/><texture name="t" type="2d" file="t.png"/>
      <material name="t" texture="t"/></asset><worldbody><body name="obj_000" pos="1 2 3" euler="10 20 30">
      <freejoint/><geom type="mesh" mesh="m" material="t" group="2"/></body></worldbody></mujoco>"""
    assets = {"m.obj": encode_obj(scale_and_quantize(corners, 1.0), appearance), "t.png": appearance.texture_png}
    scenery = load_scenery(mujoco.MjModel.from_xml_string(xml, assets))
    seen = scenery.parts[0]
    assert scenery.names == ("obj_000",)
    assert seen.texture is not None
    u, v = seen.texture.corner_uv.mean(axis=1).T
    height, width = seen.texture.picture.shape[:2]
    found = seen.texture.picture[((1 - v) * height).astype(int), (u * width).astype(int)]
    np.testing.assert_array_equal(found, corners.vertex_colors[corners.faces[:, 0]])  # faces keep their order


def test_the_slab_of_records_is_the_box_of_the_model():
    xml = """<mujoco><worldbody><body name="table" pos="0.1 0 -0.02" quat="0.980066578 0 0 0.198669331">
      <geom type="box" size="0.5 0.3 0.02" rgba="0.70588 0.58824 0.47059 1"/></body></worldbody></mujoco>"""
    model, record = load_scenery(mujoco.MjModel.from_xml_string(xml)), make_scenery([], [], SLAB)
    np.testing.assert_allclose(model.parts[0].vertices, record.parts[0].vertices, atol=1e-7)
    assert model.colors == record.colors == ((180, 150, 120),)


def test_a_box_is_closed_and_faces_outward():
    mesh = make_box_mesh(np.array([0.1, 0.2, 0.3]))
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=True)
    assert solid.is_watertight
    assert solid.volume == pytest.approx(8 * 0.1 * 0.2 * 0.3)


@pytest.mark.parametrize("size", [(160, 120), (120, 160)])
@pytest.mark.parametrize("view", ["front", "top"])
def test_views_show_every_object_whole_and_as_large_as_fits(size, view):
    meshes = [ball(-0.3, 0.0), ball(0.25, 0.1), ball(0.0, -0.2, 0.09)]
    scenery = make_scenery(["a", "b", "c"], meshes, SLAB)
    eye = make_front_camera(scenery, *size, azimuth=0.5) if view == "front" else make_top_camera(scenery, *size)
    ids = render_pictures(scenery, [eye])[0].ids
    rows, columns = np.nonzero((ids >= 0) & (ids < 3))
    assert set(np.unique(ids)) >= {0, 1, 2}
    assert rows.min() > 0
    assert rows.max() < size[1] - 1
    assert columns.min() > 0
    assert columns.max() < size[0] - 1
    assert max(np.ptp(rows) / size[1], np.ptp(columns) / size[0]) > 0.8


def test_left_is_left_and_behind_is_up_in_both_views():
    scenery = make_scenery(["left", "right", "back"], [ball(-0.2, 0), ball(0.2, 0), ball(0, 0.2)], SLAB)
    for view in render_pictures(scenery, [make_front_camera(scenery, 160, 120), make_top_camera(scenery, 160, 120)]):
        middle = [np.argwhere(view.ids == k).mean(axis=0) for k in range(3)]
        assert middle[0][1] < middle[2][1] < middle[1][1]
        assert middle[2][0] < min(middle[0][0], middle[1][0])


def test_a_smaller_picture_of_the_same_camera_sees_the_same():
    camera = Camera(500.0, 510.0, 317.0, 243.0, 640, 480)
    small = resize_camera(camera, 320)
    assert (small.width, small.height) == (320, 240)
    corner = lambda c, u, v: ((u - c.cx) / c.fx, (v - c.cy) / c.fy)  # noqa: E731
    np.testing.assert_allclose(corner(camera, -0.5, -0.5), corner(small, -0.5, -0.5))
    np.testing.assert_allclose(corner(camera, 639.5, 479.5), corner(small, 319.5, 239.5))
    assert resize_camera(camera, 320) == small


def test_the_judges_sheet_is_the_same_twice_and_takes_any_label():
    scenery = make_scenery(["a", "b"], [ball(-0.1, 0), ball(0.1, 0)], SLAB)
    labels = ["<b>mug</b> " + "x" * 500, "杯子\n\x1b[31m\u202e"]
    first, second = (draw_judge_sheet(scenery, labels, side=200) for _ in range(2))
    assert first.shape == (200, 400, 3)
    np.testing.assert_array_equal(first, second)
    plain = draw_judge_sheet(scenery, [], side=200)
    assert (first != plain).any()


def test_a_sketch_shows_what_the_renderer_shows():
    scenery = make_scenery(["a", "b"], [ball(-0.1, 0.05), ball(0.1, 0)], SLAB)
    sketcher = PreviewRenderer(scenery.parts, scenery.colors)
    for eye in (make_front_camera(scenery, 160, 120), make_top_camera(scenery, 160, 120)):
        picture, ids = sketcher.draw(eye.camera, eye.camera_to_table)
        np.testing.assert_array_equal(ids, render_pictures(scenery, [eye])[0].ids)
        np.testing.assert_array_equal(picture, sketcher.draw(eye.camera, eye.camera_to_table)[0])
        shadow = picture[ids == 2].astype(int).sum(axis=1)
        assert shadow.min() < 0.8 * np.median(shadow)


def test_a_sketch_wears_textures_vertex_colours_and_plain_ones():
    texture = Texture(np.full((4, 4, 3), (250, 10, 10), dtype=np.uint8), np.zeros((12, 3, 2)))
    boxes = [moved_box(x) for x in (-0.2, 0.0, 0.2)]
    parts = [
        replace(boxes[0], texture=texture),
        replace(boxes[1], vertex_colors=np.full((len(boxes[1].vertices), 3), (10, 250, 10), dtype=np.uint8)),
        boxes[2],
        TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int32)),
    ]
    eye = make_top_camera(make_scenery(["a", "b", "c", "d"], parts, SLAB), 120, 60)
    picture, ids = PreviewRenderer(parts, [None, None, (10, 10, 250), None]).draw(eye.camera, eye.camera_to_table)
    assert set(np.unique(ids)) == {-1, 0, 1, 2}
    assert [int(picture[ids == k].mean(axis=0).argmax()) for k in range(3)] == [0, 1, 2]


def test_a_texture_repeats_in_a_sketch_as_in_the_renderer():
    corners = np.array([[-0.2, -0.1, 0.01], [0.2, -0.1, 0.01], [0.2, 0.1, 0.01], [-0.2, 0.1, 0.01]])
    faces = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)
    red_then_blue = np.array([[[250, 10, 10]] * 8 + [[10, 10, 250]] * 8] * 16, dtype=np.uint8)
    cloth = TriangleMesh(corners, faces, None, Texture(red_then_blue, 5.0 * corners[faces][..., :2]))  # u from -1 to 1
    scenery = make_scenery(["cloth"], [cloth], SLAB)
    eye = make_top_camera(scenery, 120, 60)
    sketch, ids = PreviewRenderer(scenery.parts, scenery.colors).draw(eye.camera, eye.camera_to_table)
    columns = np.flatnonzero(ids[30] == 0)
    quarters = columns[(np.array([0.125, 0.375, 0.625, 0.875]) * len(columns)).astype(int)]
    for picture in (sketch, render_pictures(scenery, [eye])[0].color):
        assert picture[30, quarters].argmax(axis=1).tolist() == [0, 2, 0, 2]


@pytest.mark.heavy
def test_tags_of_a_crowd_do_not_cover_one_another():
    grid = [ball(0.09 * i, 0.09 * j) for i in range(4) for j in range(4)]
    scenery = make_scenery([str(i) for i in range(16)], grid, SLAB)
    eye = make_top_camera(scenery, 512, 512)
    picture, ids = PreviewRenderer(scenery.parts, scenery.colors).draw(eye.camera, eye.camera_to_table)
    tagged = draw_boxes(picture, ids, ["ball"] * 16)
    colors = {tuple(ImageColor.getrgb(color)) for color in BOX_COLORS}
    filled = [np.all(tagged == color, axis=2).sum() for color in colors]
    single = [draw_boxes(picture, np.where(ids == k, k, -1), ["ball"] * 16) for k in range(16)]
    alone = [np.all(one == color, axis=2).sum() for one in single for color in colors]
    assert sum(filled) > 0.9 * sum(alone)
