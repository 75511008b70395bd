"""Every category over several seeds: what the generators promise to everything downstream."""

import numpy as np
import pytest
from scipy.spatial import ConvexHull, Delaunay

from schemas.geometry import TriangleMesh
from tableverse_factory.geometry.math.transforms import matrix_from_pose
from tableverse_factory.geometry.mesh.mass_integrals import compute_signed_volume
from tableverse_factory.physics.mjcf.inertia import compute_mass_properties, is_closed
from tableverse_factory.sources.synthetic.catalogue import CATEGORIES
from tableverse_factory.sources.synthetic.model import GeneratedObject
from tableverse_factory.sources.synthetic.recipes import RECIPES, PlacedModel

SEEDS = range(5)


def specimens(name: str) -> list[GeneratedObject]:
    return [CATEGORIES[name].make(np.random.default_rng(seed)) for seed in SEEDS]


def surface_points(mesh: TriangleMesh, count: int = 800) -> np.ndarray:
    rng = np.random.default_rng(0)
    corners = mesh.vertices[mesh.faces]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    chosen = corners[rng.choice(len(corners), count, p=areas / areas.sum())]
    return np.einsum("nk,nkd->nd", rng.dirichlet([1.0, 1.0, 1.0], count), chosen)


def distance_to_pieces(points: np.ndarray, pieces: tuple[np.ndarray, ...]) -> np.ndarray:
    """How far each point lies outside the nearest convex piece, from below [m]."""
    outside = [(points @ h.equations[:, :3].T + h.equations[:, 3]).max(axis=1) for h in map(ConvexHull, pieces)]
    return np.maximum(np.min(outside, axis=0), 0.0)


@pytest.mark.parametrize("name", CATEGORIES)
class TestEveryCategory:
    def test_meshes_are_closed_moderate_and_household_sized(self, name: str) -> None:
        for model in specimens(name):
            assert is_closed(model.mesh)
            assert np.isfinite(model.mesh.vertices).all()
            assert compute_signed_volume(model.mesh) > 1e-6
            assert len(model.mesh.faces) <= 6000
            size = np.ptp(model.mesh.vertices, axis=0)
            assert 0.04 < size.max() < 0.36
            assert size.min() > 0.002
            assert 0.005 <= model.mass_kg < 2.0
            assert 0.0 <= model.shiny <= 1.0

    def test_they_rest_on_the_table_about_the_origin(self, name: str) -> None:
        for model in specimens(name):
            low, high = model.mesh.vertices.min(axis=0), model.mesh.vertices.max(axis=0)
            assert abs(low[2]) < 1e-3
            assert (low[:2] < 0.0).all()
            assert (high[:2] > 0.0).all()

    def test_inertia_comes_from_the_mesh_itself(self, name: str) -> None:
        for model in specimens(name):
            assert compute_mass_properties(model.mesh, (), model.mass_kg).source == "mesh"

    def test_pieces_cover_the_mesh_and_little_else(self, name: str) -> None:
        for model in specimens(name):
            assert distance_to_pieces(surface_points(model.mesh), model.pieces).max() < 7e-4
            # Sixteen wedges bulge a little into a round cavity, a book's pages stand back behind its boards.
            assert sum(ConvexHull(piece).volume for piece in model.pieces) < 1.2 * compute_signed_volume(model.mesh)
            # No piece reaches beyond the object's own box.
            corners = np.concatenate(model.pieces)
            assert (corners.min(axis=0) > model.mesh.vertices.min(axis=0) - 1e-6).all()
            assert (corners.max(axis=0) < model.mesh.vertices.max(axis=0) + 1e-6).all()

    def test_same_numbers_same_object(self, name: str) -> None:
        first, second = (CATEGORIES[name].make(np.random.default_rng(9)) for _ in range(2))
        points = surface_points(first.mesh)
        assert first.mesh.vertices.tobytes() == second.mesh.vertices.tobytes()
        assert first.texture(points).tobytes() == second.texture(points).tobytes()

    def test_textures_colour_every_point(self, name: str) -> None:
        for model in specimens(name):
            colors = np.asarray(model.texture(surface_points(model.mesh)))
            assert colors.shape == (800, 3)
            assert np.isfinite(colors).all()
            assert colors.min() >= 0.0
            assert colors.max() <= 255.0

    def test_cavities_are_open(self, name: str) -> None:
        """A thing that fits between floor and rim touches no convex piece: the simulation feels the cavity."""
        for model in specimens(name):
            if model.cavity is None:
                continue
            cavity = model.cavity
            heights = np.linspace(cavity.floor + 1e-4, cavity.rim, 12)
            radii = np.interp(heights, [cavity.floor, cavity.rim], [cavity.floor_radius, cavity.rim_radius])
            angles = np.linspace(0.0, 2 * np.pi, 23)
            points = np.array(
                [
                    [0.9 * r * np.cos(a), 0.9 * r * np.sin(a), z]
                    for r, z in zip(radii, heights, strict=True)
                    for a in angles
                ]
            )
            assert distance_to_pieces(points, model.pieces).min() > 0.0
            assert cavity.rim - cavity.floor > 0.02


@pytest.mark.heavy
def test_containers_and_roles_exist() -> None:
    containers = [name for name in CATEGORIES if specimens(name)[0].cavity is not None]
    assert {"bowl", "mug", "cup", "pan"} <= set(containers)
    assert all(("container" in CATEGORIES[name].roles) == (name in containers) for name in CATEGORIES)
    assert all(specimens(name)[0].top is not None for name, c in CATEGORIES.items() if {*c.roles} & {"base", "dish"})


@pytest.mark.heavy
@pytest.mark.parametrize("seeds", [range(4), pytest.param(range(4, 10), marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", RECIPES)
def test_recipes_place_things_apart_and_above_the_table(name: str, seeds: range) -> None:
    for seed in seeds:
        group = RECIPES[name][1](np.random.default_rng(seed))
        assert 1 <= len(group) <= 5
        for item in group:
            assert item.vertices()[:, 2].min() > 0.0
        for first, second in ((a, b) for k, a in enumerate(group) for b in group[k + 1 :]):
            assert not overlap(first, second), (name, seed, first.model.label, second.model.label)


def overlap(a: PlacedModel, b: PlacedModel) -> bool:
    """Whether a surface point of either lies within a convex piece of the other."""
    for inner, outer in ((a, b), (b, a)):
        points = surface_points(TriangleMesh(inner.vertices(), inner.model.mesh.faces), 300)
        local = np.linalg.inv(matrix_from_pose(outer.pose)) @ np.column_stack([points, np.ones(len(points))]).T
        for piece in outer.model.pieces:
            if (Delaunay(piece).find_simplex(local[:3].T) >= 0).any():
                return True
    return False
