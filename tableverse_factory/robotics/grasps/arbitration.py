"""Which grasps to try, from above first: the paper's three stages (appendix D, multi-stage grasp relaxation)."""

import numpy as np

from schemas.trajectories import Grasps

STRICT, HEMISPHERE, CONFIDENCE = 1, 2, 3
"""The stages, as they are recorded; 0 where there was no grasp at all."""


def arbitrate(grasps: Grasps, gamma_strict: float) -> tuple[Grasps, int]:
    """The grasps of the first stage that leaves any, best score first, and that stage.

    With `a` the approach of a grasp and `z` the vertical of the table: stage 1 keeps `a·z <= gamma_strict`, stage 2
    `a·z < 0`, stage 3 the one grasp of the highest score, wherever it comes from. Equal scores stay in their order.

    Args:
        grasps: That have passed every other test.
        gamma_strict: Negative; -1 is straight down.

    Returns:
        The grasps, and 1, 2 or 3; none and 0 where none came in.
    """
    best_first = np.argsort(-grasps.scores, kind="stable").astype(np.int32)
    down = grasps.rotations[best_first, 2, 2]
    for stage, kept in ((STRICT, down <= gamma_strict), (HEMISPHERE, down < 0.0)):
        if kept.any():
            return grasps.chosen(best_first[kept]), stage
    return grasps.chosen(best_first[:1]), CONFIDENCE if len(grasps) else 0
