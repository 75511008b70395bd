"""What a segmenter's small score images say of the pixels of a picture: an id for each, on the model's device."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64

from schemas.geometry import Frozen, IdImage, Picture
from tableverse_factory.models.local.device import Tensor, torch_here
from tableverse_factory.stages.perceive.base.interfaces import TABLE_ID

REACH = 0.25
"""How far contents may stick out of their container, in shorter sides of its box."""
FOUND = 0.1
"""Share of its box that the mask of a container has to fill; a tray seen edge-on fills a fifth."""
OUTSIDE = -1.0
AT_A_TIME = 64_000_000
"""Scores at the size of the picture that are held at once; four bytes each."""


@dataclass(frozen=True, slots=True, eq=False)
class BoxQuestion(Frozen):
    """A picture and the boxes whose masks are wanted.

    Attributes:
        color: The picture.
        boxes: xmin, ymin, xmax, ymax of each object in pixels; the table's last where there is one.
        holders: Index of the object that holds each object, -1 for none.
    """

    color: Picture
    boxes: Float64[np.ndarray, "k 4"]
    holders: Int64[np.ndarray, " n"]

    @property
    def has_table(self) -> bool:
        """Whether the last box is the table's."""
        return len(self.boxes) > len(self.holders)


def inside(boxes: Float64[np.ndarray, "k 4"], height: int, width: int) -> Float64[np.ndarray, "k 4"]:
    """The boxes cut to the picture; those of which nothing is left, or that are no boxes, are all zero."""
    cut = np.clip(np.nan_to_num(boxes, nan=0.0, posinf=0.0, neginf=0.0), 0.0, [width, height, width, height])
    there = np.isfinite(boxes).all(axis=1) & (cut[:, 2] > cut[:, 0]) & (cut[:, 3] > cut[:, 1])
    return np.where(there[:, None], cut, 0.0)


def ids_of(scores: Tensor, question: BoxQuestion) -> Tensor:
    """The id image of a picture: `k + 1` for the k-th object, `TABLE_ID` for the table, 0 for neither.

    Scores are brought back by bilinear interpolation and count above 0. Contents stay near their container and cover
    it; of neighbours the one with the higher score has the pixel; the table is what no object covers (paper,
    appendix A, on seeds).

    Args:
        scores: Of each box, shape (k, s, s): the whole picture at the model's own resolution.
        question: The picture and its boxes.

    Returns:
        Shape (h, w), int16.
    """
    torch = torch_here()
    height, width = question.color.shape[:2]
    cut = inside(question.boxes, height, width)
    scores = torch.where(_tensor(cut.any(axis=1), scores)[:, None, None], scores.float(), OUTSIDE)
    ids = torch.zeros((height, width), dtype=torch.int16, device=scores.device)
    if question.has_table:
        full = _brought_back(scores[-1:], height, width)[0]
        ids = torch.where(full > 0, TABLE_ID, ids)
    scores = _near_holders(scores, cut, question)
    for members in levels(question.holders):
        owner = _owners(scores, members, height, width)
        ids = torch.where(owner > 0, owner, ids)
    return ids


def levels(holders: Int64[np.ndarray, " n"]) -> list[list[int]]:
    """Objects by how many containers they lie in: none first. Who lies in itself, however indirectly, lies in none."""
    depth = [0] * len(holders)
    for k in range(len(holders)):
        seen, at = {k}, int(holders[k])
        while 0 <= at < len(holders) and at not in seen:
            seen.add(at)
            at = int(holders[at])
        depth[k] = 0 if at in seen else len(seen) - 1
    return [[k for k, own in enumerate(depth) if own == level] for level in sorted(set(depth))]


def _near_holders(scores: Tensor, cut: Float64[np.ndarray, "k 4"], question: BoxQuestion) -> Tensor:
    """Scores of contents, below zero beyond the reach of what their container covers.

    A container whose mask is far smaller than its box was not found: then its box is what it covers.
    """
    torch = torch_here()
    height, width = question.color.shape[:2]
    side = scores.shape[-1]
    result = scores.clone()
    for k, holder in enumerate(question.holders.tolist()):
        if not 0 <= holder < len(question.holders):
            continue
        box = cut[holder]
        x0, y0, x1, y1 = (box / [width, height, width, height] * side).tolist()
        rows, columns = slice(math.floor(y0), math.ceil(y1)), slice(math.floor(x0), math.ceil(x1))
        boxed = torch.full_like(scores[holder], OUTSIDE)
        boxed[rows, columns] = -OUTSIDE
        found = (scores[holder, rows, columns] > 0).sum() >= FOUND * (y1 - y0) * (x1 - x0)
        covered = torch.where(found, scores[holder], boxed)
        around = _widest(covered, max(1, round(REACH * min(x1 - x0, y1 - y0))))
        result[k] = torch.where(around > 0, result[k], result[k].clamp(max=OUTSIDE))
    return result


def _widest(scores: Tensor, reach: int) -> Tensor:
    """The highest score within a square of so many cells to each side."""
    pool = torch_here().nn.functional.max_pool2d
    size = 2 * reach + 1
    rows = pool(scores[None, None], (size, 1), stride=1, padding=(reach, 0))
    return pool(rows, (1, size), stride=1, padding=(0, reach))[0, 0]


def _owners(scores: Tensor, members: list[int], height: int, width: int) -> Tensor:
    """`k + 1` of the member with the highest score at each pixel, if it is above 0; of equal ones the first."""
    torch = torch_here()
    best = torch.zeros((height, width), device=scores.device)
    owner = torch.zeros((height, width), dtype=torch.int16, device=scores.device)
    step = max(1, AT_A_TIME // (height * width))
    for start in range(0, len(members), step):
        part = _tensor(np.array(members[start : start + step]), scores)
        top, index = _brought_back(scores[part], height, width).max(dim=0)
        better = top > best
        owner = torch.where(better, (part + 1).to(torch.int16)[index], owner)
        best = torch.where(better, top, best)
    return owner


def _brought_back(scores: Tensor, height: int, width: int) -> Tensor:
    """Scores at the size of the picture, shape (k, h, w)."""
    interpolate = torch_here().nn.functional.interpolate
    return interpolate(scores[:, None], (height, width), mode="bilinear", align_corners=False)[:, 0]


def _tensor(values: Any, like: Tensor) -> Any:
    return torch_here().from_numpy(np.ascontiguousarray(values)).to(like.device, non_blocking=True)


def as_ids(ids: np.ndarray) -> IdImage:
    """An id image as the rest of the factory has it."""
    result: IdImage = ids.astype(np.int32)
    return result
