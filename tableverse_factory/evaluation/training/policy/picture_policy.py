"""Policy on pictures: it looks with depth from the front and the wrist while at home, and reads the instruction."""

from pathlib import Path

import numpy as np
from scipy import ndimage

from tableverse_factory.delivery.episodes.pictures import DEPTH
from tableverse_factory.evaluation.benchmark.policy import EpisodeStart, PolicyError
from tableverse_factory.evaluation.training.policy.camera_calibration import calibrate_camera, load_surfaces
from tableverse_factory.evaluation.training.policy.chunk_policy import Observation, to_tensor
from tableverse_factory.evaluation.training.policy.goals import Scenes
from tableverse_factory.evaluation.training.policy.instructions import number_instruction
from tableverse_factory.evaluation.training.policy.motions import MOTION_POINTS
from tableverse_factory.evaluation.training.policy.mounts import list_intrinsics, list_mounts, mount_cameras
from tableverse_factory.evaluation.training.policy.object_policy import Look, ObjectPolicy
from tableverse_factory.evaluation.training.policy.packed_pictures import CAMERAS, SIZE, WINDOW
from tableverse_factory.evaluation.training.policy.rotations import apply
from tableverse_factory.evaluation.training.policy.seen_points import Rays, compute_rays, gather_points
from tableverse_factory.evaluation.training.policy.shipped import SHIPPED
from tableverse_factory.evaluation.training.policy.sight import describe_points, make_picture_network
from tableverse_factory.evaluation.training.policy.tensors import GRASP, describe_relations
from tableverse_factory.evaluation.training.policy.windows import STRIDE, crop_eye, find_window, thin_eye
from tableverse_factory.models.local.device import Tensor, import_torch

torch = import_torch()
functional = torch.nn.functional

EMPTY_M = 0.003  # opening of fingers that hold nothing
CELL_M = 0.02  # of the grid in which marked points hang together
LEAST_POINTS = 12  # that are marked of an object
SURE = 0.5
BEHIND_M = 0.012, 0.024, 0.036  # behind what is seen, things are taken to be solid
LEAST_HEIGHT_M = 0.003  # over the table, of what is added there
MOST_POINTS = 600  # seen ones that are kept clear of


class PicturePolicy(ObjectPolicy):
    """Policy on pictures; `weights` is the file that training writes, by default that of the package."""

    pictures = (*CAMERAS, *(camera + DEPTH for camera in CAMERAS))
    picture_size = SIZE

    def __init__(self, weights: str | Path | None = None) -> None:
        super().__init__(make_picture_network(0), weights, SHIPPED["picture"])

    def reset(self, start: EpisodeStart) -> None:
        """Begin an episode."""
        super().reset(start)
        self._eyes = mount_cameras(start.robot)
        self._words = number_instruction(start.instruction)

    def look(self, observation: Observation) -> Look:
        """Mark X, Y and all objects in the pictures, and lift what is marked to points."""
        colors, depth, rays = self._crop_pictures(observation)
        base = self._base_at, self._base_turn
        points = rays.lift(depth, base)[0]
        share = self._mark(colors, depth, rays)
        x = _keep_connected(points, share[0])
        y = _keep_connected(points, share[1] * ~x)
        others = (share[2] > SURE) & ~x & ~y
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self._start.seed)
            self._seen = gather_points(rays, depth, base, (x[None], y[None], others[None]))
        scenes = Scenes(*self._seen, *base, *describe_relations([str(self._start.relation)]))
        along = functional.normalize((self._base_turn @ rays.along.mT).mT[0], dim=1)
        return Look(scenes, points[x], *(fill_behind(points[mask], along[mask]) for mask in (x, y, others)))

    def _crop_pictures(self, observation: Observation) -> tuple[Tensor, Tensor, Rays]:
        """Crop colours, (1, cameras, 3, h, w), and depth, (1, m) [m], to the windows; return their rays too."""
        colors, depths, intrinsics, eyes = [], [], [], []
        for camera, said, surface in zip(CAMERAS, self._eyes, load_surfaces(self._start.robot), strict=True):
            depth = observation[camera + DEPTH][..., 0]
            thin = depth[::STRIDE, ::STRIDE]
            eye = calibrate_camera(thin, said, surface)
            left, top = find_window(thin, thin_eye(eye))
            window = slice(top, top + WINDOW[0]), slice(left, left + WINDOW[1])
            colors.append(observation[camera][window].transpose(2, 0, 1))
            depths.append(depth[window])
            intrinsics.append(list_intrinsics(crop_eye(eye, left, top)))
            eyes.append(eye)
        rays = compute_rays(to_tensor(np.stack(intrinsics))[None], to_tensor(list_mounts(eyes)))
        return to_tensor(np.stack(colors))[None] / 255, to_tensor(np.stack(depths)).reshape(1, -1), rays

    def _mark(self, colors: Tensor, depth: Tensor, rays: Rays) -> Tensor:
        """Compute the probability that a pixel shows X, Y or any object; none does without depth. Shape (3, m)."""
        scores = self._network.sight(colors, describe_points(rays, depth, self._base_turn), self._words)
        share: Tensor = scores.sigmoid()[0].transpose(0, 1).flatten(1) * (depth > 0)
        return share

    def locate_release(self, _observation: Observation, _tcp: np.ndarray) -> tuple[Tensor, Tensor]:
        """Locate the gripper that lets X go where it was drawn, as X was grasped."""
        at = apply(self._placed_turn, self._grasp_at - self._middle) + self._placed_at
        return at, self._placed_turn @ self._grasp_turn

    def see_objects(self, _observation: Observation) -> tuple[Tensor, Tensor]:
        """Place the points that were seen, X as it moves with the gripper once it is grasped."""
        points, present = self._seen
        points = points[:, :, :MOTION_POINTS].clone()
        if self._phase > GRASP:
            at, turn = self._command_tcp()
            local = apply(self._grasp_turn.mT, points[0, 0] - self._grasp_at)
            points[0, 0] = apply(turn, local) + at
        return points, present

    def is_left_behind(self, observation: Observation) -> bool:
        """Test whether the fingers have closed on nothing."""
        return bool(observation["state"][2 * len(self._chain.lower)] < EMPTY_M)


def fill_behind(points: Tensor, along: Tensor) -> Tensor:
    """Add points behind the seen surface of things, whose far side no camera sees. Shapes (n, 3)."""
    step = max(1, -(-len(points) // MOST_POINTS))
    points, along = points[::step], along[::step]
    behind = torch.cat([points + depth * along for depth in BEHIND_M])
    return torch.cat([points, behind[behind[:, 2] > LEAST_HEIGHT_M]])


def _keep_connected(points: Tensor, share: Tensor) -> Tensor:
    """Keep, of what is marked, the points that hang together and are marked most surely. Shapes (m, 3) and (m,)."""
    bound = min(SURE, float(share.topk(LEAST_POINTS).values[-1]))
    marked = ((share >= bound) & (share > 0)).nonzero()[:, 0]
    if not len(marked):
        raise PolicyError("policy_error", "the cameras see nothing: their depth is 0 everywhere")
    cells = np.floor(points[marked].numpy() / CELL_M).astype(int)
    cells -= cells.min(0)
    grid = np.zeros(cells.max(0) + 1, dtype=bool)
    grid[tuple(cells.T)] = True
    numbers, count = ndimage.label(grid, np.ones((3, 3, 3)))
    own = numbers[tuple(cells.T)]
    weight = np.bincount(own, share[marked].numpy(), count + 1)
    kept = torch.zeros(len(share), dtype=torch.bool)
    kept[marked[torch.tensor(own == weight.argmax())]] = True
    return kept
