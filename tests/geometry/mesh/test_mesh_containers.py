"""Every container still holds what is dropped into it, on the convex pieces that leave the factory."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from schemas.config import RectifyConfig
from schemas.geometry import Pose, TriangleMesh
from tableverse_factory.geometry.convex.decompose import decompose
from tableverse_factory.geometry.math.aabb import aabb
from tableverse_factory.geometry.mesh.meshes import from_trimesh, read_mesh
from tableverse_factory.physics.mjcf.spec import make_scene_body
from tableverse_factory.physics.simulate.freefall import simulate_fall
from tableverse_factory.sources.synthetic.catalogue import CATEGORIES
from tests.helpers.cavity_probe import holds_probe

pytestmark = pytest.mark.heavy

UPRIGHT = Pose(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
VESSELS = ("bowl", "cup", "mug", "pan")
SCANNED = (
    "024_bowl", "blue_cup", "frypan", "glazed_rim_porcelain_ramekin", "green_bowl", "porcelain_cup", "porcelain_spoon",
)  # fmt: skip
# The scanned pitcher has its lid on: it holds nothing.


def dropped_on(mesh: TriangleMesh, hulls: tuple[TriangleMesh, ...], radius: float = 0.008) -> np.ndarray:
    """Where a ball ends that is dropped over the middle of a dish."""
    dish = make_scene_body("dish", mesh, hulls, 1.0, 1.0, UPRIGHT)
    low, high = aabb(mesh.vertices)
    above = Pose(np.array([*((low + high) / 2)[:2], high[2] + 1.5 * radius]), UPRIGHT.quaternion_wxyz)
    ball = from_trimesh(trimesh.creation.icosphere(1, radius))
    probe = make_scene_body("ball", ball, (ball,), 1.0, 0.005, above)
    rest = simulate_fall([dish], [probe], gap_m=0.0, timestep_s=0.002, max_time_s=3.0)
    return rest.poses[0].position


def stays(mesh: TriangleMesh, hulls: tuple[TriangleMesh, ...]) -> bool:
    low, high = aabb(mesh.vertices)
    end = dropped_on(mesh, hulls)
    middle = np.abs(end[:2] - ((low + high) / 2)[:2]).max() < 0.35 * float(np.ptp([low[:2], high[:2]], axis=0).min())
    return bool(middle and end[2] < high[2] + 0.008)


@pytest.mark.parametrize("name", [*VESSELS[:2], *(pytest.param(name, marks=pytest.mark.slow) for name in VESSELS[2:])])
def test_vessels_of_our_own_hold_the_probe(name: str, tmp_path: Path) -> None:
    model = CATEGORIES[name].make(np.random.default_rng(4))
    pieces = decompose(model.mesh, RectifyConfig(), tmp_path)
    assert holds_probe(model.mesh, pieces.hulls, UPRIGHT)
    assert not holds_probe(
        model.mesh, (one_hull(model.mesh, tmp_path),), UPRIGHT
    )  # closed by its hull, it holds nothing


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("name", VESSELS)
def test_many_vessels_of_our_own_hold_the_probe(name: str, seed: int, tmp_path: Path) -> None:
    model = CATEGORIES[name].make(np.random.default_rng(seed))
    assert holds_probe(model.mesh, decompose(model.mesh, RectifyConfig(), tmp_path).hulls, UPRIGHT)


def test_what_is_dropped_on_a_plate_stays_on_it(tmp_path: Path) -> None:
    mesh = CATEGORIES["plate"].make(np.random.default_rng(0)).mesh
    assert stays(mesh, decompose(mesh, RectifyConfig(), tmp_path).hulls)


@pytest.mark.shared
@pytest.mark.parametrize(
    "name", [name if name == "blue_cup" else pytest.param(name, marks=pytest.mark.slow) for name in SCANNED]
)
def test_scanned_containers_hold_the_probe(shared_dir: Path, name: str, tmp_path: Path) -> None:
    path = shared_dir / "meshes" / f"{name}.obj"
    mesh = read_mesh(path.read_bytes(), path.name)
    assert holds_probe(mesh, decompose(mesh, RectifyConfig(), tmp_path).hulls, UPRIGHT)


@pytest.mark.shared
@pytest.mark.slow
def test_what_is_dropped_on_the_scanned_plate_stays_on_it(shared_dir: Path, tmp_path: Path) -> None:
    path = shared_dir / "meshes" / "plate.obj"
    mesh = read_mesh(path.read_bytes(), path.name)
    assert stays(mesh, decompose(mesh, RectifyConfig(), tmp_path).hulls)


def one_hull(mesh: TriangleMesh, cache: Path) -> TriangleMesh:
    return decompose(mesh, RectifyConfig(max_pieces=1), cache).hulls[0]
