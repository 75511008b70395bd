"""What a policy sees and is told: the environment's own pictures, points of the true surfaces, and nothing else."""

import numpy as np
import pytest

from tableverse_factory.evaluation.benchmark.play import make_start, open_episode, play_episode
from tableverse_factory.evaluation.benchmark.policy import POINTS_PER_OBJECT
from tableverse_factory.geometry.mesh.surface_samples import measure_distance_to_surface
from tableverse_factory.physics.mjcf.scene_objects import load_mesh

pytestmark = pytest.mark.heavy


class Looker:
    """Looks at its pictures at the steps of `look`, and ends the episode at the third."""

    picture_size = (24, 32)

    def __init__(self, pictures, look=(0, 1)):
        self.pictures, self.look, self.seen = pictures, look, []

    def reset(self, start):
        self.start, self.step, self.before = start, 0, None

    def act(self, observation):
        if self.step == 2:
            self.before["front"]  # of the step before, which nobody looked at
        if self.step in self.look:
            self.seen.append({name: observation[name] for name in observation})
        self.step, self.before = self.step + 1, observation
        return np.zeros(8)


def test_pictures_are_those_of_the_environment_also_when_seldom_looked_at(benchmark, dataset):
    episode = next(e for e in benchmark.episodes if e.perturbation.axis == "camera")
    pictures = ("front", "wrist_depth", "front_instances")
    policy, seldom = Looker(pictures), Looker(pictures, look=(1,))
    result = play_episode(benchmark, episode, dataset, policy)
    assert (result.reason, result.steps) == ("out_of_time", episode.limit_steps)
    again = play_episode(benchmark, episode, dataset, seldom)
    assert (again.reason, again.steps) == ("out_of_time", episode.limit_steps)
    assert len(policy.seen) == 2
    assert {"state", "objects", *pictures} == set(policy.seen[0])
    for name in pictures:
        assert policy.seen[0][name].shape[:2] == (24, 32)
        assert np.array_equal(policy.seen[1][name], seldom.seen[0][name])


def test_a_picture_of_a_past_step_is_an_error_not_another_picture(benchmark, dataset):
    policy = Looker(("front",), look=())
    result = play_episode(benchmark, benchmark.episodes[0], dataset, policy)
    assert (result.reason, result.steps) == ("policy_error", 2)
    assert "front of a past step was not looked at then" in result.detail


def test_points_lie_on_the_surfaces_of_the_objects_in_their_order(benchmark, dataset):
    episode = next(e for e in benchmark.episodes if e.perturbation.axis == "clutter")
    env = open_episode(benchmark, episode, dataset)
    observation, _ = env.reset(seed=episode.seed)
    start = make_start(episode, env, privileged=False)
    assert start.env is None
    assert start.points.shape == (len(observation["objects"]), POINTS_PER_OBJECT, 3)
    assert env.sim.object_ids[:2] == (episode.task.x_id, episode.task.y_id)
    for name, points in zip(env.sim.object_ids, start.points, strict=True):
        mesh = load_mesh(env.scene.files(), name)
        assert measure_distance_to_surface(points.astype(np.float64), mesh, 2000).max() < 1e-5
    assert np.array_equal(start.points, make_start(episode, env, privileged=True).points)
    command = (start.lower + start.upper) / 2
    assert np.allclose(start.to_action(command), 0.0)
    assert np.allclose(env.action_to_command(start.to_action(start.upper)), start.upper)
