"""Multi-stage grasp relaxation (paper, appendix D): which grasps to try first, from above."""

import numpy as np

from schemas.trajectories import Grasps

STRICT, HEMISPHERE, CONFIDENCE = 1, 2, 3  # stages as recorded; 0 where there was no grasp at all


def arbitrate(grasps: Grasps, gamma_strict: float) -> tuple[Grasps, int]:
    """Return the grasps of the first stage that leaves any, best score first, and the stage (0 for no grasps).

    With `a` the approach of a grasp and `z` the table's vertical: stage 1 keeps `a·z <= gamma_strict`, stage 2 `a·z <
    0`, stage 3 the single grasp of the highest score. `gamma_strict` is negative, -1 straight down. Ties keep their
    order.
    """
    best_first = np.argsort(-grasps.scores, kind="stable").astype(np.int32)
    down = grasps.rotations[best_first, 2, 2]
    for stage, kept in ((STRICT, down <= gamma_strict), (HEMISPHERE, down < 0.0)):
        if kept.any():
            return grasps.select(best_first[kept]), stage
    return grasps.select(best_first[:1]), CONFIDENCE if len(grasps) else 0
