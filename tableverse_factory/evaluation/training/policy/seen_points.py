"""Points of a scene that cameras with depth see: of X, of Y and of what else stands about them."""

from dataclasses import dataclass

from tableverse_factory.evaluation.training.policy.demonstrations import ROWS
from tableverse_factory.evaluation.training.policy.goals import DRAWN_POINTS, OTHER_POINTS
from tableverse_factory.evaluation.training.policy.packed_pictures import WINDOW
from tableverse_factory.evaluation.training.policy.rotations import apply, matrix_from_quaternion
from tableverse_factory.models.local.device import Tensor, import_torch

torch = import_torch()

NEAR_M = 0.3  # of X or Y, within which others are seen
CANDIDATES = 384  # points of others that patches are made of


@dataclass(frozen=True, slots=True)
class Rays:
    """Rays of the pixels (m) of all cameras' windows in the frame of the arm's base; a depth of 1 m is `along` away."""

    origin: Tensor  # (m, 3)
    along: Tensor  # (b, m, 3)

    def reach(self, depth: Tensor) -> Tensor:
        """Return the points at depths [m], in the frame of the base. Shapes (b, m) and (b, m, 3)."""
        return self.origin + depth[..., None] * self.along

    def lift(self, depth: Tensor, base: tuple[Tensor, Tensor], pixels: Tensor | None = None) -> Tensor:
        """Lift depths [m] of these pixels, all by default, to points in the table frame.

        Shapes (b, k), position (b, 3) and matrix (b, 3, 3) of the base, (b, k); (b, k, 3).
        """
        own = self if pixels is None else Rays(self.origin[pixels], _pick(self.along, pixels))
        return apply(base[1][:, None], own.reach(depth)) + base[0][:, None]


def _pick(values: Tensor, pixels: Tensor) -> Tensor:
    return values.gather(1, pixels[..., None].expand(-1, -1, values.shape[2]))


def compute_rays(intrinsics: Tensor, mounts: Tensor) -> Rays:
    """Compute the rays of windows: fx, fy, cx, cy [px], (b, c, 4), and poses of cameras in the base frame, (c, 7)."""
    height, width = WINDOW
    device = mounts.device
    v, u = torch.meshgrid(torch.arange(height, device=device), torch.arange(width, device=device), indexing="ij")
    fx, fy, cx, cy = (each[..., None, None] for each in intrinsics.unbind(-1))
    ray = torch.stack([(u - cx) / fx, (v - cy) / fy, torch.ones_like(u) + 0 * cx], -1).flatten(2, 3)
    along = apply(matrix_from_quaternion(mounts[:, 3:])[:, None], ray)
    return Rays(mounts[:, None, :3].expand(along.shape[1:]).flatten(0, 1), along.flatten(1, 2))


def choose_pixels(mask: Tensor, count: int, weight: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Choose pixels of masks at random, each as seldom again as possible; those of greater `weight` first.

    Shapes (b, m); (b, count), and which masks have any, (b,).
    """
    order = torch.rand(mask.shape, device=mask.device) if weight is None else weight
    chosen = torch.where(mask, order, -torch.inf).topk(count, 1).indices
    known = mask.sum(1, keepdim=True).clamp(min=1, max=count)
    return chosen.gather(1, torch.arange(count, device=mask.device)[None] % known), mask.any(1)


def gather_points(
    rays: Rays, depth: Tensor, base: tuple[Tensor, Tensor], masks: tuple[Tensor, Tensor, Tensor]
) -> tuple[Tensor, Tensor]:
    """Gather points of X, of Y and of patches of others near them, as `goals.Scenes` has those of objects.

    Args:
        rays: Of all pixels.
        depth: Shape (b, m) [m].
        base: Position and matrix of the arm's base in the table frame. Shapes (b, 3) and (b, 3, 3).
        masks: Pixels of X, of Y and of others. Shape (b, m).

    Returns:
        Points in the table frame, (b, ROWS, DRAWN_POINTS, 3), and which rows are there, (b, ROWS). A row of others
        holds `OTHER_POINTS` points over and over.
    """
    rows, there = [], []
    for mask in masks[:2]:
        pixels, any_seen = choose_pixels(mask, DRAWN_POINTS)
        rows.append(rays.lift(depth.gather(1, pixels), base, pixels))
        there.append(any_seen)
    middles = torch.stack([row.mean(1) for row in rows], 1)
    pixels, any_seen = choose_pixels(masks[2], 4 * CANDIDATES)
    others = rays.lift(depth.gather(1, pixels), base, pixels)
    away = torch.cdist(others[..., :2], middles[..., :2]).amin(2)
    nearest = away.topk(CANDIDATES, 1, largest=False).indices
    others = others.gather(1, nearest[..., None].expand(-1, -1, 3))
    near = (away.gather(1, nearest) < NEAR_M) & any_seen[:, None]
    patches, kept = _cut_patches(others, near)
    repeated = patches.repeat(1, 1, DRAWN_POINTS // OTHER_POINTS, 1)
    points = torch.cat([torch.stack(rows, 1), repeated], 1)
    return points, torch.cat([torch.stack(there, 1), kept], 1)


def _cut_patches(points: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
    """Cut patches about points far from one another: the points nearest to each.

    Shapes (b, n, 3) and (b, n); (b, ROWS - 2, OTHER_POINTS, 3) and (b, ROWS - 2).
    """
    away = torch.where(valid, torch.inf, -1.0)
    seeds = []
    for _ in range(ROWS - 2):
        seed = points.gather(1, away.argmax(1)[:, None, None].expand(-1, -1, 3))
        seeds.append(seed)
        away = torch.minimum(away, (points - seed).norm(dim=2))
    between = torch.cdist(torch.cat(seeds, 1), points) + torch.where(valid, 0.0, 1e3)[:, None]
    nearest = between.topk(OTHER_POINTS, 2, largest=False)
    patches = points[torch.arange(len(points), device=points.device)[:, None, None], nearest.indices]
    return patches, nearest.values[..., -1] < NEAR_M
