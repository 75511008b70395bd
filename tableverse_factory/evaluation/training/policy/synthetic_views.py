"""Views of synthetic tables, which are settled and drawn but never built: sight learns names from thousands of them."""

from collections.abc import Sequence

import numpy as np
import trimesh

from schemas.geometry import Pose, TriangleMesh
from schemas.identity import make_object_id
from tableverse_factory.core.seeding import make_rng
from tableverse_factory.delivery.episodes.actors import PEDESTAL_COLOR, RenderScene
from tableverse_factory.delivery.episodes.incremental_renderer import PaintedMeshes
from tableverse_factory.delivery.learning.variation import draw_lighting
from tableverse_factory.evaluation.benchmark.splits import select_known_phrases
from tableverse_factory.evaluation.training.policy.views import PosedScene, View, load_figure, take_view
from tableverse_factory.geometry.math.aabb import aabb_size
from tableverse_factory.geometry.math.transforms import compose_poses, invert_pose, quaternion_about_z, transform_points
from tableverse_factory.geometry.mesh.meshes import place_mesh
from tableverse_factory.geometry.relations.relations import compute_body_features
from tableverse_factory.physics.mjcf.inertia import compute_volume_moments
from tableverse_factory.physics.render.render import Pattern
from tableverse_factory.robotics.robots.base import ELBOW_MARGIN_M
from tableverse_factory.robotics.robots.registry import load_arm
from tableverse_factory.sources.synthetic import studio
from tableverse_factory.sources.synthetic.recipes import PlacedModel
from tableverse_factory.sources.synthetic.scene import arrange_scene
from tableverse_factory.stages.curate.appearance import DescribedObject, measure_color_shares
from tableverse_factory.stages.curate.phrases import name_objects

TABLES = 2_000
EDGE_M = 0.008  # at most, between the points at which a surface's colour is measured
VIEWER_SHARE, VIEWER_RAD = 0.65, 0.3  # of arms that stand about the viewer's side, as most do, and how far about it
DISTANCE_M = 0.4, 0.62  # of the base from the middle of two objects
TRIES = 20


def take_synthetic_view(number: int, robot: str) -> View:
    """Take a view of a table from its number, with an arm of this name; it depends on the two alone."""
    rng = make_rng(number, "synthetic tables", "pictures of policies")
    placed, half_xy = arrange_scene(rng, f"table {number}")
    whole = Pose(np.zeros(3), quaternion_about_z(float(rng.uniform(0.0, 2 * np.pi))))
    placed = [PlacedModel(item.model, compose_poses(whole, item.pose)) for item in placed]
    figure, base = load_figure(robot), _draw_base(placed, robot, rng)
    table = studio.make_table(rng, half_xy)
    board = PaintedMeshes(
        (place_mesh(table.mesh, whole), figure.pedestal(base)), (_turn_pattern(table.texture, whole), PEDESTAL_COLOR)
    )
    meshes, paints = [item.model.mesh for item in placed], [item.model.texture for item in placed]
    moving = PaintedMeshes((*meshes, *figure.meshes), (*paints, *[None] * len(figure.meshes)))
    names = tuple(map(make_object_id, range(len(placed))))
    poses = [*(item.pose for item in placed), *figure.home_poses(base)]
    cast = RenderScene(board, moving, names, ())
    return take_view(PosedScene(cast, names, poses, base, _name_objects(placed), draw_lighting(rng)), robot)


def _name_objects(placed: Sequence[PlacedModel]) -> dict[str, tuple[str, ...]]:
    """List the phrases that tell each object from the others, but for held-out nouns."""
    names = name_objects([_describe_object(item) for item in placed], [1.0] * len(placed))
    return {
        make_object_id(index): select_known_phrases(name.distinguishing_phrases) for index, name in enumerate(names)
    }


def _describe_object(item: PlacedModel) -> DescribedObject:
    mesh = item.model.mesh
    vertices, faces = trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, EDGE_M)
    colors = np.clip(np.rint(item.model.texture(vertices)), 0, 255).astype(np.uint8)
    return DescribedObject(
        label=item.model.label,
        body=compute_body_features(place_mesh(mesh, item.pose)),
        size=aabb_size(mesh.vertices),
        volume_m3=compute_volume_moments(mesh, ()).volume_m3,
        colors=measure_color_shares(TriangleMesh(vertices, faces.astype(np.int32), colors)),
    )


def _turn_pattern(pattern: Pattern, whole: Pose) -> Pattern:
    back = invert_pose(whole)
    return lambda points: pattern(transform_points(back, points))


def _draw_base(placed: Sequence[PlacedModel], robot: str, rng: np.random.Generator) -> Pose:
    """Draw a pose of the arm's base that faces the middle of two objects, the clearest if none is clear of all."""
    vertices = np.concatenate([item.vertices()[:, :2] for item in placed])
    room = load_arm(robot).base_radius_m + ELBOW_MARGIN_M
    found: list[tuple[float, Pose]] = []
    for _ in range(TRIES):
        pair = rng.choice(len(placed), 2, replace=False)
        middle = np.mean([placed[k].vertices()[:, :2].mean(axis=0) for k in pair], axis=0)
        angle = rng.normal(0.0, VIEWER_RAD) if rng.random() < VIEWER_SHARE else rng.uniform(-np.pi, np.pi)
        foot = middle + rng.uniform(*DISTANCE_M) * np.array([np.sin(angle), -np.cos(angle)])
        clear = float(np.linalg.norm(vertices - foot, axis=1).min())
        found.append((clear, Pose(np.array([*foot, 0.0]), quaternion_about_z(float(np.pi / 2 + angle)))))
        if clear >= room:
            break
    return max(found, key=lambda each: each[0])[1]
