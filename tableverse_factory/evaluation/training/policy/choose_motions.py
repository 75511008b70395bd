"""Choice of the motions that are learnt, for curves of success against scenes and motions."""

import numpy as np

from tableverse_factory.core.errors import InputError
from tableverse_factory.evaluation.training.policy.demonstrations import Demonstrations


def choose_motions(own: Demonstrations, scenes: int | None = None, motions: int | None = None) -> np.ndarray:
    """Choose among the demonstrations that are not held out: of the first `scenes` scenes, `motions` in turn.

    In turn means the first of each scene, then the second, and so on. A smaller choice is part of a larger one. Scenes
    are in the order in which they were packed: by dataset, then by id. None is no limit.

    Returns:
        A mask of shape (n,).

    Raises:
        InputError: `too_few_motions` if there are fewer scenes or motions.
    """
    rows = np.flatnonzero(own.held_out == 0)
    names, scene = np.unique(own.scenes[rows], return_inverse=True)
    if scenes is not None:
        if scenes > len(names):
            raise InputError(f"{scenes} scenes are to be learnt, and {len(names)} have motions", "too_few_motions")
        rows, scene = rows[scene < scenes], scene[scene < scenes]
    if motions is not None:
        if motions > len(rows):
            raise InputError(
                f"{motions} motions are to be learnt, and the {len(np.unique(scene))} scenes have {len(rows)}",
                "too_few_motions",
            )
        turn = np.array([np.count_nonzero(scene[:k] == scene[k]) for k in range(len(scene))], dtype=np.int64)
        rows = rows[np.lexsort((scene, turn))[:motions]]
    chosen = np.zeros(len(own), dtype=bool)
    chosen[rows] = True
    return chosen
