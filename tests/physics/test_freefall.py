"""Isolated free fall: a ball tells an open vessel from a closed one, and what falls keeps its gap."""

from collections.abc import Callable

import numpy as np
import pytest
from simple_scenes import UPRIGHT, box

from schemas.geometry import Pose, TriangleMesh
from tableverse_factory.errors import GeometryError
from tableverse_factory.geometry.hulls import bounded_hull
from tableverse_factory.geometry.transforms import identity_pose, normalized_quaternion
from tableverse_factory.physics.freefall import holds_probe
from tableverse_factory.synth import vessels
from tableverse_factory.synth.model import Model

VESSELS = (vessels.bowl, vessels.mug, vessels.cup, vessels.pan)


def pieces_of(model: Model) -> tuple[TriangleMesh, ...]:
    return tuple(bounded_hull(piece, 64, 1e-4) for piece in model.pieces)


@pytest.mark.parametrize("make", VESSELS)
def test_an_open_vessel_holds_the_probe_and_its_hull_does_not(make: Callable[[np.random.Generator], Model]) -> None:
    model = make(np.random.default_rng(0))
    assert holds_probe(model.mesh, pieces_of(model), identity_pose())
    assert not holds_probe(model.mesh, (bounded_hull(model.mesh.vertices, 64, 1e-4),), identity_pose())


def test_the_probe_knows_pose_and_scale() -> None:
    model = vessels.mug(np.random.default_rng(1))
    pose = Pose(np.array([0.4, -0.2, 0.1]), normalized_quaternion(np.array([1.0, 0.05, 0.0, 2.0])))
    assert holds_probe(model.mesh, pieces_of(model), pose, scale=1.5)


@pytest.mark.parametrize("quaternion", [UPRIGHT, np.array([0.0, 1.0, 0.0, 0.0])])
def test_what_has_no_cavity_as_it_stands_says_so(quaternion: np.ndarray) -> None:
    mesh = box(0.1, 0.1, 0.1) if quaternion[0] else vessels.mug(np.random.default_rng(0)).mesh
    with pytest.raises(GeometryError, match="no cavity"):
        holds_probe(mesh, (bounded_hull(mesh.vertices, 64, 1e-4),), Pose(np.zeros(3), quaternion))
