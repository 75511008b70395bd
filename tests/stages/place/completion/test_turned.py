"""Completion of estimated depth: whole things where the depth is bent, and what is hidden goes on around the axis."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from manifold3d import Manifold
from scipy import ndimage

from schemas.codec import encode
from schemas.geometry import DepthImage, Pose, TriangleMesh
from schemas.objects import PerceivedObjects
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.evaluation.bench.completion import render_noisy_view, stand_on_table
from tableverse_factory.geometry.math.camera import backproject
from tableverse_factory.geometry.math.transforms import matrix_from_pose, quaternion_about_z, transform_points
from tableverse_factory.geometry.mesh.meshes import from_trimesh, place_mesh
from tableverse_factory.geometry.mesh.raycasting import make_raycasting_scene, pack_pixel_rays, pack_rays
from tableverse_factory.geometry.mesh.voxel_solids import from_manifold, to_manifold
from tableverse_factory.stages.place.completion.handle import join_handles
from tableverse_factory.stages.place.completion.ray_misfit import MISS_M, RaySample, sample_rays
from tableverse_factory.stages.place.completion.select_shape import complete_by_carving
from tableverse_factory.stages.place.completion.turned_profile import (
    TurnedProfile,
    build_turned_solid,
    intersect_turned,
)
from tableverse_factory.stages.place.interfaces import Completion
from tableverse_factory.stages.place.view.object_view import view_object
from tableverse_factory.stages.place.view.support_from_depth import find_supports

PLATE = [(0.0, 0.0), (0.06, 0.0), (0.1, 0.02), (0.097, 0.022), (0.057, 0.004), (0.0, 0.004)]
MUG = [(0.0, 0.0), (0.035, 0.0), (0.04, 0.085), (0.036, 0.085), (0.032, 0.005), (0.0, 0.005)]

AZIMUTH = 0.7  # of the camera
MUG_COLOR, WOOD = (30, 40, 160), (180, 150, 110)


def turn(profile: list[tuple[float, float]], height: float = 0.0) -> TriangleMesh:
    solid = trimesh.creation.revolve(np.array(profile), sections=64)
    mesh = from_trimesh(solid)
    return TriangleMesh(mesh.vertices + np.array([0.0, 0.0, height]), mesh.faces)


def bend(scene: PerceivedObjects, share: float = 0.012) -> PerceivedObjects:
    """Bend each object's depth over the picture, and its distance, as a net does, by a share of the distance."""
    depth = scene.observation.depth.astype(np.float64)
    rows, columns = np.indices(depth.shape)
    for item in scene.objects:
        own = scene.instance_ids == item.instance_id
        size = np.sqrt(own.sum())
        wave = np.sin(columns / size * 2.0 + item.instance_id) * np.cos(rows / size * 2.5)
        depth = np.where(own, depth * (1.0 + share * (wave + (-1) ** item.instance_id)), depth)
    bent = _replace_depth(scene, depth)
    return replace(bent, observation=replace(bent.observation, bend=0.015))


def complete(*meshes: TriangleMesh) -> list[Completion]:
    return complete_all(bend(render_noisy_view(meshes, AZIMUTH, 0.85, np.random.default_rng(3), 0.0005)))


def complete_all(scene: PerceivedObjects) -> list[Completion]:
    supports = find_supports(scene.objects, scene.camera_to_table)
    return [complete_by_carving(scene, view_object(scene, item, supports[item.object_id])) for item in scene.objects]


def place(completion: Completion) -> TriangleMesh:
    assert completion.pose is not None
    return place_mesh(completion.mesh, completion.pose)


def test_a_plate_under_a_mug_is_one_closed_piece_without_a_hole_and_the_mug_is_hollow() -> None:
    plate, mug = complete(turn(PLATE), turn(MUG, 0.004))
    assert [plate.method, mug.method] == ["carved/turned", "carved/turned"]
    for completion in (plate, mug):
        solid = to_manifold(completion.mesh)
        assert (len(solid.decompose()), solid.genus()) == (1, 0)
        inside = trimesh.Trimesh(completion.mesh.vertices, completion.mesh.faces).convex_hull.volume
        assert solid.volume() < 0.8 * inside, "the hollow is filled"
    down = pack_rays(
        np.array([0.0, 0.0, 1.0]), np.array([[x, y, -1.0] for x in (-0.04, 0.0, 0.04) for y in (0.0, 0.03)])
    )
    hit = make_raycasting_scene(place(plate)).cast_rays(down, nthreads=1)["t_hit"].numpy()
    assert np.isfinite(hit).all(), "what the mug hides is missing"
    assert np.ptp(place(plate).vertices[:, :2], axis=0) == pytest.approx(0.2, rel=0.12)


def test_a_ball_stays_round() -> None:
    (ball,) = complete(stand_on_table(from_trimesh(trimesh.creation.icosphere(3, 0.04))))
    assert ball.method == "carved/turned"
    assert to_manifold(ball.mesh).volume() == pytest.approx(4 / 3 * np.pi * 0.04**3, rel=0.3)
    size = np.ptp(ball.mesh.vertices, axis=0)
    assert size == pytest.approx(0.08, rel=0.15)


def test_a_box_is_a_box_and_a_lying_can_lies() -> None:
    (box,) = complete(stand_on_table(from_trimesh(trimesh.creation.box((0.16, 0.1, 0.06)))))
    assert box.method == "carved/box"
    can = trimesh.creation.cylinder(0.03, 0.14)
    can.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [0.0, 1.0, 0.0]))
    (lying,) = complete(stand_on_table(from_trimesh(can)))
    assert lying.method == "carved/lying"
    assert np.ptp(lying.mesh.vertices, axis=0)[2] == pytest.approx(0.14, rel=0.15)


def _build_mug(turned: float = 0.0, radius: float = 0.022, thickness: float = 0.005) -> TriangleMesh:
    """Build a mug whose handle is seen from its side, or turned by an angle."""
    handle = trimesh.creation.torus(radius, thickness)
    upright = trimesh.transformations.rotation_matrix(np.pi / 2, [1.0, 0.0, 0.0])
    beside = trimesh.transformations.rotation_matrix(AZIMUTH + np.pi / 2 + turned, [0.0, 0.0, 1.0])
    handle.apply_transform(beside @ trimesh.transformations.translation_matrix([0.05, 0.0, 0.045]) @ upright)
    inside = to_manifold(turn([(0.0, 0.0), (0.036, 0.0), (0.036, 0.09), (0.0, 0.09)]))
    return from_manifold(to_manifold(turn(MUG)) + (to_manifold(from_trimesh(handle)) - inside))


def test_a_mug_keeps_its_handle() -> None:
    """Estimated depth is bent by more than the handle is thick: its silhouette tells that it is there."""
    (found,) = complete(_build_mug())
    assert found.method == "carved/turned"
    vertices = place(found).vertices
    farthest = vertices[np.linalg.norm(vertices[:, :2], axis=1).argmax()]
    assert np.linalg.norm(farthest[:2]) == pytest.approx(0.077, abs=0.004)
    assert np.arctan2(farthest[1], farthest[0]) == pytest.approx(AZIMUTH + np.pi / 2, abs=0.25)
    assert len(to_manifold(found.mesh).decompose()) == 1


def test_a_mug_without_a_handle_gets_none() -> None:
    (found,) = complete(turn(MUG))
    assert found.method == "carved/turned"
    assert np.ptp(place(found).vertices[:, :2], axis=0) == pytest.approx(0.08, abs=0.003)
    assert len(to_manifold(found.mesh).decompose()) == 1


def _look_at_mug(mug: TriangleMesh, *, filled: bool, handle: tuple[int, int, int] = MUG_COLOR) -> PerceivedObjects:
    """A picture of a mug on wood by estimated depth; the mask fills the gap of its handle, with depth of the handle."""
    scene = bend(render_noisy_view([mug], AZIMUTH, 0.85, np.random.default_rng(3), 0.0005))
    own = scene.instance_ids > 0
    mask = ndimage.binary_fill_holes(own) if filled else own
    nearest = ndimage.distance_transform_edt(~own, return_distances=False, return_indices=True)
    depth = scene.observation.depth[nearest[0], nearest[1]]
    color = np.where(own[..., None], np.uint8(MUG_COLOR), np.uint8(WOOD))
    columns = np.indices(own.shape)[1]
    color[own & (columns > np.quantile(columns[own], 0.75))] = handle
    (item,) = scene.objects
    scene = replace(
        scene,
        observation=replace(scene.observation, color=color),
        instance_ids=np.where(mask, item.instance_id, np.minimum(scene.instance_ids, 0)),
    )
    return _replace_depth(scene, np.where(mask, depth, scene.observation.depth))


@pytest.mark.parametrize("filled", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_a_handle_is_as_thick_as_it_looks_and_its_gap_open_though_the_mask_fills_it(filled: bool) -> None:
    mug = _build_mug(radius=0.032, thickness=0.006)
    scene = _look_at_mug(mug, filled=filled)
    true = _look_at_mug(mug, filled=False).instance_ids > 0
    if filled:
        (view,) = [view_object(scene, scene.objects[0], find_supports(scene.objects, scene.camera_to_table)["obj_000"])]
        assert (view.own & ~true[view.window]).sum() > 500, "nothing is filled"
    (found,) = complete_all(scene)
    assert to_manifold(found.mesh).genus() == 1
    rays = pack_pixel_rays(scene.observation.camera, scene.camera_to_table)
    shown = np.isfinite(make_raycasting_scene(place(found)).cast_rays(rays, nthreads=1)["t_hit"].numpy())
    columns = np.indices(true.shape)[1]
    handle = columns > np.quantile(columns[true], 0.8)
    assert (shown & true & handle).sum() > 0.8 * ((shown | true) & handle).sum()


def test_a_handle_in_the_colour_of_the_table_stays() -> None:
    (found,) = complete_all(_look_at_mug(_build_mug(radius=0.03, thickness=0.01), filled=False, handle=WOOD))
    assert to_manifold(found.mesh).genus() == 1


def test_a_body_that_is_too_narrow_gets_no_handle_along_its_side() -> None:
    can = turn([(0.0, 0.0), (0.035, 0.0), (0.035, 0.1), (0.0, 0.1)])
    scene = bend(render_noisy_view([can], AZIMUTH, 0.85, np.random.default_rng(3), 0.0005), 0.0)
    view = view_object(scene, scene.objects[0], find_supports(scene.objects, scene.camera_to_table)["obj_000"])
    aside = Pose(0.006 * np.array([-np.sin(AZIMUTH), np.cos(AZIMUTH), 0.0]), quaternion_about_z(0.0))
    body = to_manifold(turn([(0.0, 0.0), (0.03, 0.0), (0.03, 0.1), (0.0, 0.1)]))
    mesh, _, _ = join_handles(view, sample_rays(view), body, None, aside)
    assert to_manifold(mesh).volume() == pytest.approx(body.volume(), rel=1e-3)


def look_by_wrong_depth(*meshes: TriangleMesh, error_m: float = 0.018) -> PerceivedObjects:
    return render_noisy_view(meshes, AZIMUTH, 0.85, np.random.default_rng(3), 0.0005, error_m)


CAN = turn([(0.0, 0.0), (0.033, 0.0), (0.033, 0.12), (0.0, 0.12)])
BLOCK = stand_on_table(from_trimesh(trimesh.creation.box((0.12, 0.07, 0.05))))


@pytest.mark.parametrize(
    ("mesh", "kind", "least"),
    [(CAN, "carved/turned", 0.75), pytest.param(BLOCK, "carved/box", 0.75, marks=pytest.mark.slow)],
)
def test_what_errors_of_a_sensor_tear_becomes_plain(mesh: TriangleMesh, kind: str, least: float) -> None:
    (found,) = complete_all(look_by_wrong_depth(mesh))
    assert found.method == kind
    one, two = to_manifold(place(found)), to_manifold(mesh)
    assert (one ^ two).volume() > least * (one + two).volume()


def test_a_can_by_the_usual_errors_of_a_sensor_is_a_can() -> None:
    """Not its dented front turned, or inflated."""
    (found,) = complete_all(look_by_wrong_depth(CAN, error_m=0.004))
    assert found.method == "carved/turned"
    one, two = to_manifold(place(found)), to_manifold(CAN)
    assert (one ^ two).volume() > 0.9 * (one + two).volume()


HEXAGON = from_manifold(Manifold.cylinder(0.1, 0.04, 0.04, 6))
OVAL = from_manifold(Manifold.cylinder(0.12, 0.04, 0.04, 48).scale((1.0, 0.85, 1.0)))


@pytest.mark.parametrize("mesh", [HEXAGON, pytest.param(OVAL, marks=pytest.mark.slow)], ids=["hexagon", "oval"])
def test_what_is_not_round_stays_so_where_depth_is_good(mesh: TriangleMesh) -> None:
    (found,) = complete_all(look_by_wrong_depth(mesh, error_m=0.0))
    one, two = to_manifold(place(found)), to_manifold(mesh)
    assert (one ^ two).volume() > 0.9 * (one + two).volume()


def test_a_shape_far_from_what_was_read_is_refused_with_its_distance() -> None:
    """Readings behind a thing: where it is seen to stand it cannot be so far away."""
    scene = bend(render_noisy_view([BLOCK], AZIMUTH, 0.85, np.random.default_rng(3), 0.0005), 0.0)
    depth = np.where(scene.instance_ids == 1, 1.2 * scene.observation.depth, scene.observation.depth)
    points = 1.2 * scene.objects[0].points_camera
    far = replace(
        scene,
        observation=replace(scene.observation, depth=depth.astype(np.float32)),
        objects=(replace(scene.objects[0], points_camera=points),),
    )
    view = view_object(far, far.objects[0], find_supports(far.objects, far.camera_to_table)["obj_000"])
    with pytest.raises(GeometryError, match="mm from what was read"):
        complete_by_carving(far, view)


def _build_rack() -> TriangleMesh:
    """Build a grid of bars on four feet: it has as many holes as errors of the depth could tear."""
    bars = [((0.16, 0.008, 0.008), (0.0, y, 0.03)) for y in np.linspace(-0.06, 0.06, 5)]
    bars += [((0.008, 0.128, 0.008), (x, 0.0, 0.03)) for x in np.linspace(-0.076, 0.076, 6)]
    bars += [((0.008, 0.008, 0.03), (x, y, 0.015)) for x in (-0.076, 0.076) for y in (-0.06, 0.06)]
    solid = sum((Manifold.cube(size, True).translate(at) for size, at in bars), Manifold())
    return stand_on_table(from_manifold(solid))


@pytest.mark.slow  # another counterexample of torn shapes
def test_what_has_holes_keeps_them() -> None:
    (found,) = complete_all(look_by_wrong_depth(_build_rack(), error_m=0.0))
    assert to_manifold(found.mesh).genus() > 15


@pytest.mark.slow  # another counterexample of torn shapes
def test_a_tray_that_holds_a_can_gets_no_lid() -> None:
    whole, hollow = (Manifold.cube(size, True) for size in ((0.2, 0.15, 0.02), (0.192, 0.142, 0.02)))
    tray = from_manifold(whole.translate((0.0, 0.0, 0.01)) - hollow.translate((0.0, 0.0, 0.014)))
    can = turn([(0.0, 0.0), (0.02, 0.0), (0.02, 0.06), (0.0, 0.06)], 0.0041)
    found, _ = complete_all(look_by_wrong_depth(tray, can, error_m=0.008))
    assert found.method not in ("carved/box", "carved/turned")


@pytest.mark.parametrize("read", ["nothing", "the table behind"])
def test_a_handle_goes_on_where_a_sensor_does_not_read_it(read: str) -> None:
    """Its mask and colour show that it is there, and its ends in which plane."""
    scene = render_noisy_view([_build_mug(-0.3)], AZIMUTH, 0.85, np.random.default_rng(3), 0.0005)
    (item,), observation, own = scene.objects, scene.observation, scene.instance_ids > 0
    rows, columns = np.indices(own.shape)
    lost = own & (columns > np.quantile(columns[own], 0.93))
    lost &= np.abs(rows - np.median(rows[lost])) < 9
    eye = scene.camera_to_table.position
    rays = transform_points(scene.camera_to_table, backproject(np.ones(own.shape), observation.camera)[lost]) - eye
    depth = observation.depth.copy()
    depth[lost] = 0.0 if read == "nothing" else -eye[2] / rays[:, 2]
    color = np.where(own[..., None], np.uint8([30, 40, 160]), np.uint8([180, 150, 110]))
    item = replace(item, points_camera=backproject(depth, observation.camera)[own & (depth > 0.0)])
    scene = replace(scene, observation=replace(observation, depth=depth, color=color), objects=(item,))
    supports = find_supports(scene.objects, scene.camera_to_table)
    view = view_object(scene, item, supports[item.object_id])
    assert view.unread[lost[view.window]].mean() > 0.8
    found = complete_by_carving(scene, view)
    solid = to_manifold(found.mesh)
    assert len(solid.decompose()) == 1
    assert solid.genus() >= 1, "the handle is broken"
    assert np.linalg.norm(place(found).vertices[:, :2], axis=1).max() == pytest.approx(0.077, abs=0.006)


BOWL = [
    (0.0, 0.0),
    (0.035, 0.0),
    (0.06, 0.025),
    (0.075, 0.065),
    (0.072, 0.065),
    (0.057, 0.027),
    (0.033, 0.004),
    (0.0, 0.004),
]


def smear(scene: PerceivedObjects, half_px: int) -> PerceivedObjects:
    """Smooth the depth of a sensor over edges, as its filters do."""
    return _replace_depth(scene, ndimage.uniform_filter(scene.observation.depth, 2 * half_px + 1))


def _replace_depth(scene: PerceivedObjects, depth: DepthImage) -> PerceivedObjects:
    depth = depth.astype(np.float32)
    points = backproject(depth, scene.observation.camera)
    objects = tuple(
        replace(item, points_camera=points[scene.instance_ids == item.instance_id]) for item in scene.objects
    )
    return replace(scene, observation=replace(scene.observation, depth=depth), objects=objects)


def test_a_bowl_that_holds_a_can_stays_one_where_depth_is_smeared() -> None:
    can = turn([(0.0, 0.0), (0.025, 0.0), (0.025, 0.08), (0.0, 0.08)], 0.004)
    scene = smear(render_noisy_view([turn(BOWL), can], AZIMUTH, 0.85, np.random.default_rng(3), 0.0005), 6)
    supports = find_supports(scene.objects, scene.camera_to_table)
    bowl = complete_by_carving(scene, view_object(scene, scene.objects[0], supports[scene.objects[0].object_id]))
    found, true = to_manifold(place(bowl)), to_manifold(turn(BOWL))
    assert (found ^ true).volume() > 0.45 * (found + true).volume()


@pytest.mark.slow  # builds on two executors compare bytes in the fast run
def test_the_same_picture_gives_the_same_bytes() -> None:
    first, second = (complete(turn(PLATE), turn(MUG, 0.004)) for _ in range(2))
    assert [encode(a.mesh) for a in first] == [encode(b.mesh) for b in second]


def test_rays_meet_a_profile_where_they_meet_its_mesh() -> None:
    rng = np.random.default_rng(5)
    heights = np.array([0.0, 0.03, 0.08, 0.1])
    frame = Pose(np.array([0.03, -0.02, 0.01]), quaternion_about_z(0.3))
    profile = TurnedProfile(frame, heights, np.full(4, 0.05), np.array([0.02, 0.1]), np.full(2, 0.045))
    solid, _ = build_turned_solid(profile)
    mesh = from_manifold(solid.transform(matrix_from_pose(frame)[:3]))
    eye = np.array([0.3, -0.2, 0.4])
    directions = rng.uniform(-0.05, 0.12, (400, 3)) - eye
    rays = RaySample(eye, np.ascontiguousarray(directions.T), np.ones(400), np.ones(400))
    there = make_raycasting_scene(mesh).cast_rays(pack_rays(eye, directions), nthreads=1)
    true = np.minimum(there["t_hit"].numpy().astype(np.float64), MISS_M)
    found = intersect_turned(rays, profile)
    both = (true < MISS_M) & (found < MISS_M)
    assert both.sum() > 100
    assert ((true < MISS_M) == (found < MISS_M)).mean() > 0.98
    assert np.quantile(np.abs(true - found)[both], 0.95) < 0.005
