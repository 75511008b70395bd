"""Id image of a picture from the low-resolution mask scores of a segmenter, on the model's device."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64

from schemas.geometry import TABLE_ID, Frozen, Picture
from tableverse_factory.models.local.device import Tensor, import_torch

REACH = 0.25  # maximum distance of contents from their container's mask, in shorter sides of its box
MIN_FILL = 0.1  # share of its box that a container's mask must fill to be used; a tray seen edge-on fills a fifth
OUTSIDE = -1.0
MAX_SCORES = 64_000_000  # maximum number of scores at the size of the picture held at once; four bytes each


@dataclass(frozen=True, slots=True, eq=False)
class BoxQuestion(Frozen):
    """A picture, boxes as xmin, ymin, xmax, ymax [px], the table's last, and each object's container, -1 for none."""

    color: Picture
    boxes: Float64[np.ndarray, "k 4"]
    holders: Int64[np.ndarray, " n"]

    @property
    def has_table(self) -> bool:
        """Whether the last box is the table's."""
        return len(self.boxes) > len(self.holders)


def clip_boxes(boxes: Float64[np.ndarray, "k 4"], height: int, width: int) -> Float64[np.ndarray, "k 4"]:
    """Clip boxes to the picture; empty and invalid boxes become zero."""
    cut = np.clip(np.nan_to_num(boxes, nan=0.0, posinf=0.0, neginf=0.0), 0.0, [width, height, width, height])
    is_valid = np.isfinite(boxes).all(axis=1) & (cut[:, 2] > cut[:, 0]) & (cut[:, 3] > cut[:, 1])
    return np.where(is_valid[:, None], cut, 0.0)


def compute_id_image(scores: Tensor, question: BoxQuestion) -> Tensor:
    """Compute the id image of a `BoxSegmenter` as int16 from each box's scores over the picture, shape (k, s, s).

    Scores are upsampled bilinearly; a mask is where its score is above 0. Contents stay near their container and cover
    it; between others the higher score wins; the table is what no object covers (paper, appendix A, on seeds).
    """
    torch = import_torch()
    height, width = question.color.shape[:2]
    cut = clip_boxes(question.boxes, height, width)
    scores = torch.where(_to_tensor(cut.any(axis=1), scores)[:, None, None], scores.float(), OUTSIDE)
    ids = torch.zeros((height, width), dtype=torch.int16, device=scores.device)
    if question.has_table:
        full = _resize_scores(scores[-1:], height, width)[0]
        ids = torch.where(full > 0, TABLE_ID, ids)
    scores = _limit_to_containers(scores, cut, question)
    for members in group_by_depth(question.holders):
        owner = _assign_pixels(scores, members, height, width)
        ids = torch.where(owner > 0, owner, ids)
    return ids


def group_by_depth(holders: Int64[np.ndarray, " n"]) -> list[list[int]]:
    """Group objects by the number of containers around them, none first; cycles count as no container."""
    depth = [0] * len(holders)
    for k in range(len(holders)):
        seen, at = {k}, int(holders[k])
        while 0 <= at < len(holders) and at not in seen:
            seen.add(at)
            at = int(holders[at])
        depth[k] = 0 if at in seen else len(seen) - 1
    return [[k for k, own in enumerate(depth) if own == level] for level in sorted(set(depth))]


def _limit_to_containers(scores: Tensor, cut: Float64[np.ndarray, "k 4"], question: BoxQuestion) -> Tensor:
    """Clamp scores of contents below zero beyond `REACH` of their container's mask, or of its box if far larger."""
    torch = import_torch()
    height, width = question.color.shape[:2]
    side = scores.shape[-1]
    result = scores.clone()
    for k, holder in enumerate(question.holders.tolist()):
        if not 0 <= holder < len(question.holders):
            continue
        x0, y0, x1, y1 = (cut[holder] / [width, height, width, height] * side).tolist()
        rows, columns = slice(math.floor(y0), math.ceil(y1)), slice(math.floor(x0), math.ceil(x1))
        boxed = torch.full_like(scores[holder], OUTSIDE)
        boxed[rows, columns] = -OUTSIDE
        found = (scores[holder, rows, columns] > 0).sum() >= MIN_FILL * (y1 - y0) * (x1 - x0)
        covered = torch.where(found, scores[holder], boxed)
        around = _dilate_scores(covered, max(1, round(REACH * min(x1 - x0, y1 - y0))))
        result[k] = torch.where(around > 0, result[k], result[k].clamp(max=OUTSIDE))
    return result


def _dilate_scores(scores: Tensor, reach: int) -> Tensor:
    """Take the maximum score within a square of `reach` cells to each side."""
    pool, size = import_torch().nn.functional.max_pool2d, 2 * reach + 1
    rows = pool(scores[None, None], (size, 1), stride=1, padding=(reach, 0))
    return pool(rows, (1, size), stride=1, padding=(0, reach))[0, 0]


def _assign_pixels(scores: Tensor, members: list[int], height: int, width: int) -> Tensor:
    """Return `k + 1` of the member with the highest score above 0 at each pixel; the first of equal ones."""
    torch = import_torch()
    best = torch.zeros((height, width), device=scores.device)
    owner = torch.zeros((height, width), dtype=torch.int16, device=scores.device)
    step = max(1, MAX_SCORES // (height * width))
    for start in range(0, len(members), step):
        part = _to_tensor(np.array(members[start : start + step]), scores)
        top, index = _resize_scores(scores[part], height, width).max(dim=0)
        better = top > best
        owner = torch.where(better, (part + 1).to(torch.int16)[index], owner)
        best = torch.where(better, top, best)
    return owner


def _resize_scores(scores: Tensor, height: int, width: int) -> Tensor:
    interpolate = import_torch().nn.functional.interpolate
    return interpolate(scores[:, None], (height, width), mode="bilinear", align_corners=False)[:, 0]


def _to_tensor(values: Any, like: Tensor) -> Any:
    return import_torch().from_numpy(np.ascontiguousarray(values)).to(like.device, non_blocking=True)
