import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from schemas.geometry import Camera, Pose, TriangleMesh
from tableverse_factory.geometry.math.camera import backproject, project
from tableverse_factory.geometry.math.transforms import invert_pose, rotation_matrix, transform_points
from tableverse_factory.geometry.mesh.meshes import from_trimesh
from tableverse_factory.physics.render.normals import compute_corner_normals
from tableverse_factory.physics.render.raycast import Raycaster
from tableverse_factory.physics.render.render import Lighting, look_at, render

CAMERA = Camera(120.0, 118.0, 63.0, 49.0, 128, 96)
coordinate = st.floats(-2.0, 2.0)


def sphere(radius: float, center: tuple[float, float, float], subdivisions: int = 4) -> TriangleMesh:
    mesh = from_trimesh(trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius))
    return TriangleMesh(mesh.vertices + np.array(center), mesh.faces)


def plane(half: float, height: float = 0.0) -> TriangleMesh:
    corners = np.array([[-half, -half, height], [half, -half, height], [half, half, height], [-half, half, height]])
    return TriangleMesh(corners, np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32))


class TestLookAt:
    def test_axes_are_opencv(self) -> None:
        rotation = rotation_matrix(look_at(np.array([0.0, -2.0, 0.0]), np.zeros(3)).quaternion_wxyz)
        assert_allclose(rotation[:, 0], [1, 0, 0], atol=1e-12)  # x right
        assert_allclose(rotation[:, 1], [0, 0, -1], atol=1e-12)  # y down
        assert_allclose(rotation[:, 2], [0, 1, 0], atol=1e-12)  # z forward

    @given(st.tuples(coordinate, coordinate, coordinate), st.tuples(coordinate, coordinate, coordinate))
    def test_target_is_on_the_optical_axis_and_up_is_up(
        self, eye: tuple[float, float, float], target: tuple[float, float, float]
    ) -> None:
        distance = np.linalg.norm(np.subtract(target, eye))
        if distance < 1e-3:
            return
        pose = look_at(np.array(eye), np.array(target))
        world_to_camera = invert_pose(pose)
        assert_allclose(transform_points(world_to_camera, np.array([target])), [[0, 0, distance]], atol=1e-9)
        assert abs(np.linalg.det(rotation_matrix(pose.quaternion_wxyz)) - 1.0) < 1e-9
        above = transform_points(world_to_camera, np.add([target], [0.0, 0.0, 1.0]))[0] - [0, 0, distance]
        assert above[1] < 1e-9

    def test_straight_down_has_y_up_in_the_picture(self) -> None:
        pose = look_at(np.array([0.3, 0.1, 2.0]), np.array([0.3, 0.1, 0.0]))
        pixels = project(transform_points(invert_pose(pose), np.array([[0.3, 0.5, 0.0], [0.7, 0.1, 0.0]])), CAMERA)
        assert pixels[0, 1] < CAMERA.cy
        assert pixels[1, 0] > CAMERA.cx

    def test_same_point_twice_is_refused(self) -> None:
        with pytest.raises(ValueError, match="coincide"):
            look_at(np.ones(3), np.ones(3))


class TestGeometry:
    @pytest.mark.heavy
    def test_sphere_depth_is_analytic(self) -> None:
        radius, distance = 0.3, 1.5
        picture = render([sphere(radius, (0.0, 0.0, distance), 6)], CAMERA, Pose(np.zeros(3), np.array([1.0, 0, 0, 0])))
        v, u = np.indices((96, 128))
        rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], axis=-1)
        # |t r - c|² = R²: the nearer root is the depth, as the rays have length 1 along the axis.
        a, b = (rays**2).sum(axis=-1), rays[..., 2] * distance
        discriminant = b**2 - a * (distance**2 - radius**2)
        inside, outside = discriminant > 2e-3, discriminant < 0.0
        depth = (b - np.sqrt(np.maximum(discriminant, 0.0))) / a
        assert inside.sum() > 1000
        assert_allclose(picture.depth[inside], depth[inside], atol=2e-4)
        assert not picture.depth[outside].any()
        assert (picture.ids[inside] == 0).all()
        assert (picture.ids[outside] == -1).all()
        points = backproject(picture.depth, CAMERA)[inside]
        outward = (points - [0.0, 0.0, distance]) / radius
        assert_allclose(picture.normals[inside], outward, atol=0.05)
        assert_allclose(np.linalg.norm(picture.normals[picture.ids >= 0], axis=1), 1.0, atol=1e-5)

    @settings(max_examples=20, deadline=None)
    @given(st.floats(-1.5, 1.5), st.floats(-1.5, -0.3), st.floats(0.2, 1.5))
    def test_backprojected_depth_of_a_plane_lies_in_it(self, x: float, y: float, z: float) -> None:
        pose = look_at(np.array([x, y, z]), np.zeros(3))
        picture = render([plane(3.0)], CAMERA, pose, shadows=False)
        seen = picture.ids == 0
        points = transform_points(pose, backproject(picture.depth, CAMERA)[seen])
        assert seen.any()
        assert_allclose(points[:, 2], 0.0, atol=1e-5 * float(picture.depth.max()))

    def test_nearer_part_hides_and_empty_parts_keep_their_place(self) -> None:
        nothing = TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int32))
        parts = [nothing, plane(1.0), nothing, plane(0.2, height=0.3)]
        picture = render(parts, CAMERA, look_at(np.array([0.0, 0.0, 1.5]), np.zeros(3)))
        assert picture.ids[49, 63] == 3
        assert_allclose(picture.depth[49, 63], 1.2, atol=1e-6)
        assert set(np.unique(picture.ids)) == {-1, 1, 3} or set(np.unique(picture.ids)) == {1, 3}
        pixels, covered = Raycaster(parts).covered(CAMERA, look_at(np.array([0.0, 0.0, 1.5]), np.zeros(3)))
        assert (covered == 3).sum() == (picture.ids == 3).sum()
        assert (covered == 1).sum() > (picture.ids == 1).sum()  # the hidden part of the large plane counts
        assert pixels.max() < 128 * 96

    def test_nothing_at_all_gives_background(self) -> None:
        lighting = Lighting(background=(10.0, 200.0, 30.0))
        picture = render([], CAMERA, look_at(np.ones(3), np.zeros(3)), lighting=lighting, sky_rays=2, samples=2)
        assert (picture.ids == -1).all()
        assert not picture.depth.any()
        assert_allclose(picture.color.reshape(-1, 3), np.tile([10, 200, 30], (96 * 128, 1)), atol=1)


class TestShading:
    pose = look_at(np.array([0.0, -0.6, 1.0]), np.zeros(3))

    def test_paints_flat_texture_and_vertex_colours(self) -> None:
        red = TriangleMesh(plane(0.5).vertices, plane(0.5).faces, np.tile(np.uint8([200, 20, 20]), (4, 1)))
        lighting = Lighting(key=(0.0, 0.0, 0.0), sky=(1.0, 1.0, 1.0), gloss=0.0)
        kinds = {
            "vertex": render([red], CAMERA, self.pose, lighting=lighting),
            "flat": render([red], CAMERA, self.pose, paints=[(20, 200, 20)], lighting=lighting),
            "texture": render(
                [red],
                CAMERA,
                self.pose,
                paints=[lambda p: np.where(p[:, :1] > 0, [[20.0, 20.0, 200.0]], [[200.0, 200.0, 20.0]])],
                lighting=lighting,
            ),
        }
        assert_allclose(kinds["vertex"].color[49, 63], [200, 20, 20], atol=1)
        assert_allclose(kinds["flat"].color[49, 63], [20, 200, 20], atol=1)
        assert_allclose(kinds["texture"].color[49, 80], [20, 20, 200], atol=1)  # x > 0 is on the right
        assert_allclose(kinds["texture"].color[49, 40], [200, 200, 20], atol=1)

    def test_a_part_between_light_and_table_casts_a_shadow(self) -> None:
        parts = [plane(1.0), plane(0.1, height=0.4)]
        lighting = Lighting(key_direction=(-1.0, 0.0, 1.0))  # the shadow falls 0.4 m to the right
        at = np.rint(
            project(transform_points(invert_pose(self.pose), np.array([[0.4, 0.0, 0.0], [-0.4, 0.0, 0.0]])), CAMERA)
        )
        (u0, v0), (u1, v1) = at.astype(int)
        lit, plain = (render(parts, CAMERA, self.pose, lighting=lighting, shadows=on) for on in (True, False))
        assert lit.color[v0, u0].mean() < 0.85 * plain.color[v0, u0].mean()
        assert_allclose(lit.color[v1, u1], plain.color[v1, u1], atol=1)

    def test_sky_rays_darken_corners_only(self) -> None:
        wall = TriangleMesh(np.array([[-1, 0.1, 0], [1, 0.1, 0], [1, 0.1, 0.1], [-1, 0.1, 0.1]]), plane(1.0).faces)
        parts, eye = [plane(2.0), wall], look_at(np.array([0.0, -0.9, 0.8]), np.zeros(3))
        overcast = Lighting(key=(0.0, 0.0, 0.0))
        dark, bright = (render(parts, CAMERA, eye, lighting=overcast, shadows=False, sky_rays=n) for n in (12, 0))
        corner, far = np.rint(
            project(transform_points(invert_pose(eye), np.array([[0.0, 0.09, 0.0], [0.0, -0.25, 0.0]])), CAMERA)
        ).astype(int)
        ratio = dark.color.astype(float).mean(axis=2) / bright.color.astype(float).mean(axis=2)
        assert ratio[corner[1], corner[0]] < 0.9 < 0.97 < ratio[far[1], far[0]]

    def test_same_bytes_twice(self) -> None:
        parts = [plane(1.0), sphere(0.1, (0.0, 0.0, 0.1))]
        first, second = (render(parts, CAMERA, self.pose, sky_rays=3, samples=2) for _ in range(2))
        for name in ("color", "depth", "ids", "normals"):
            assert getattr(first, name).tobytes() == getattr(second, name).tobytes()

    def test_paints_must_fit_the_parts(self) -> None:
        with pytest.raises(ValueError, match="2 paints for 1 parts"):
            render([plane(1.0)], CAMERA, self.pose, paints=[None, None])
        with pytest.raises(ValueError, match="samples"):
            render([plane(1.0)], CAMERA, self.pose, samples=0)


class TestNormals:
    def test_round_things_are_smooth(self) -> None:
        ball = sphere(0.5, (0.0, 0.0, 0.0), 3)
        assert_allclose(compute_corner_normals(ball), ball.vertices[ball.faces] / 0.5, atol=0.02)

    @pytest.mark.parametrize("merged", [True, False])
    def test_edges_of_a_box_stay_sharp_whether_or_not_vertices_are_shared(self, merged: bool) -> None:
        box = trimesh.creation.box([1.0, 2.0, 3.0])
        mesh = from_trimesh(box)
        if not merged:
            mesh = TriangleMesh(mesh.vertices[mesh.faces].reshape(-1, 3), np.arange(36, dtype=np.int32).reshape(-1, 3))
        assert_allclose(compute_corner_normals(mesh), np.repeat(box.face_normals[:, None], 3, axis=1), atol=1e-6)

    def test_slivers_and_wide_fans_stay_finite(self) -> None:
        count = 600
        angles = 2 * np.pi * np.arange(count) / count
        rim = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(count)])
        faces = [[0, 1 + k, 1 + (k + 1) % count] for k in range(count)] + [[0, 0, 1], [1, 1, 1]]
        normals = compute_corner_normals(
            TriangleMesh(np.vstack([[0.0, 0.0, 0.5], rim]), np.array(faces, dtype=np.int32))
        )
        assert np.isfinite(normals).all()
        assert (normals[:count, :, 2] > 0.0).all()
