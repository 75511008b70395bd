"""Grasps of an object among others, by the sampler and by a server."""

import numpy as np
import pytest

from schemas.config import TrajectoriesConfig
from schemas.geometry import Pose
from tableverse_factory.models.services import Services
from tableverse_factory.physics.mjcf.scene_objects import SceneObject, make_scene_object
from tableverse_factory.robotics.grasps.interfaces import GRASP_MODELS, propose_grasps
from tests.helpers.model_server import Scripted
from tests.helpers.simple_bodies import box, middle

CONFIG = TrajectoriesConfig()


def standing(name: str, mesh, x: float, y: float) -> SceneObject:
    """Make an object that is its own convex piece."""
    return make_scene_object(name, mesh, (mesh,), Pose(np.array([x, y, 0.0]), np.array([1.0, 0.0, 0.0, 0.0])), 0.2)


def tried(arm, others, tmp_path, config=CONFIG, seed=0):
    return propose_grasps(CARTON, others, arm, config, np.random.default_rng(seed), Services(tmp_path))


CARTON = standing("carton", box(0.05, 0.03, 0.12), 0.1, 0.0)


def test_an_object_by_itself_is_held_from_above_first(arm, tmp_path):
    found = tried(arm, [], tmp_path)
    assert (found.rotations[:, 2, 2] <= CONFIG.gamma_strict).sum() > 20
    assert (np.diff(found.scores) <= 0.0).all()


def test_what_stands_close_takes_grasps_away_and_adds_none(arm, tmp_path):
    free = tried(arm, [], tmp_path)
    wall = standing("wall", box(0.05, 0.02, 0.2), 0.1, 0.03)
    crowded = tried(arm, [wall], tmp_path)
    assert 0 < len(crowded) < len(free)
    known = {position.tobytes() for position in free.positions}
    assert all(position.tobytes() in known for position in crowded.positions)
    side = crowded.positions - 0.06 * crowded.rotations[:, :, 2]
    assert not ((np.abs(side - middle(wall.standing)) < [0.025, 0.01, 0.1]).all(axis=1)).any(), "a finger in the wall"


def test_what_is_walled_in_and_roofed_has_none(arm, tmp_path):
    roof = standing("roof", box(0.3, 0.3, 0.02), 0.1, 0.0)
    roof = make_scene_object(
        "roof", roof.mesh, roof.hulls, Pose(np.array([0.1, 0.0, 0.13]), roof.pose.quaternion_wxyz), 0.2
    )
    walls = [standing("w", box(0.3, 0.02, 0.2), 0.1, 0.05 * side) for side in (-1, 1)]
    walls += [standing("w", box(0.02, 0.3, 0.2), 0.1 + 0.06 * side, 0.0) for side in (-1, 1)]
    assert len(tried(arm, [roof, *walls], tmp_path)) == 0


def test_the_same_seed_gives_the_same_bytes(arm, tmp_path):
    one, same = tried(arm, [], tmp_path, seed=5), tried(arm, [], tmp_path, seed=5)
    assert one.positions.tobytes() == same.positions.tobytes()
    assert one.scores.tobytes() == same.scores.tobytes()


def test_a_servers_grasps_need_room_too(arm, tmp_path, server):
    def base(z: float, up: bool) -> list[list[float]]:
        sign = 1.0 if up else -1.0
        return [[0.0, 1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, sign, z], [0.0, 0.0, 0.0, 1.0]]

    # Closing along y, from above at half height and near the top, and from below the table.
    above, low, below = base(0.1034 + 0.045, False), base(0.1034, False), base(-0.2, True)
    turned = [[row[1], row[0], *row[2:]] for row in below]  # right-handed again
    server.say(Scripted({"grasps": [low, above, turned], "scores": [0.9, 0.8, 1.0]}))
    config = TrajectoriesConfig(grasp_model="graspgen", grasp_url=server.url)
    found = tried(arm, [], tmp_path, config)
    assert found.scores.tolist() == pytest.approx([0.8]), "the low one has the carton in its hand"
    assert found.widths[0] == pytest.approx(0.03, abs=1e-6)


def test_every_model_of_the_configuration_is_registered():
    assert set(GRASP_MODELS) == set(TrajectoriesConfig.model_fields["grasp_model"].annotation.__args__)
