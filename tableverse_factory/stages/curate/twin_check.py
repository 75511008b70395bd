"""Check of a settled twin against its photograph: what it explains and covers, and what moved away or is left out."""

import io
from dataclasses import dataclass

import numpy as np
from PIL import Image

from schemas.geometry import TriangleMesh
from schemas.objects import PlacedObjects
from schemas.scene import Coverage, SettledScene
from tableverse_factory.geometry.relations.displacement import measure_displacement
from tableverse_factory.geometry.relations.misfit import find_misfits
from tableverse_factory.physics.render.silhouettes import measure_coverage

LEAST_EXPLAINED = 0.9  # of the area above the table
LEAST_COVERED = 0.7  # of the masks
MOST_LOST = 0.25  # share of the things that toppled, slid or are left out


@dataclass(frozen=True, slots=True)
class TwinCheck:
    """Agreement of a twin with its photograph; explained area and coverage are None without one."""

    explained_area: float | None
    coverage: Coverage | None
    n_things: int  # objects, without copies, and those that are left out
    n_lost: int  # those of them that toppled, slid or are left out
    n_poor: int  # those of them that did not, and of whose masks too little is covered, or whose shapes misfit

    @property
    def covered(self) -> float | None:
        """Share of all masks that the twin covers."""
        return None if self.coverage is None else self.coverage.whole

    @property
    def reason_codes(self) -> tuple[str, ...]:
        """Reasons why the scene is not usable, whatever a judge says."""
        explained, covered = self.explained_area, self.covered
        found = {
            "LITTLE_EXPLAINED": explained is not None and explained < LEAST_EXPLAINED,
            "POORLY_COVERED": covered is not None and covered < LEAST_COVERED,
            "MANY_LOST": self.n_lost > MOST_LOST * self.n_things,
        }
        return tuple(code for code, holds in found.items() if holds)

    @property
    def most_points(self) -> int:
        """Most points of quality, 1 to 10: a scene has no more of them than its twin shows of the photograph."""
        right = 1.0 - (self.n_lost + self.n_poor) / max(self.n_things, 1)
        known = [share for share in (self.explained_area, self.covered) if share is not None]
        return int(1.5 + 9 * min([right, *known]))


def check_twin(scene: SettledScene, meshes: tuple[TriangleMesh, ...]) -> TwinCheck:
    """Check a settled scene; `meshes` are those of its objects, in the table frame."""
    placed, coverage = scene.rectified.placed, _measure_coverage(scene.rectified.placed, meshes)
    moved = [measure_displacement(item, pose) for item, pose in zip(placed.objects, scene.poses, strict=True)]
    lost = [displacement is not None and bool(displacement.kind) for displacement in moved]
    explanation = placed.explanation
    return TwinCheck(
        None if explanation is None else explanation.measure_shares({o.object_id for o in placed.objects})[1],
        coverage,
        sum(displacement is not None for displacement in moved) + len(placed.left_out),
        sum(lost) + len(placed.left_out),
        sum(not lost[index] for index in {*(coverage.poor if coverage else ()), *find_misfits(placed)}),
    )


def _measure_coverage(placed: PlacedObjects, meshes: tuple[TriangleMesh, ...]) -> Coverage | None:
    evidence = placed.evidence
    if evidence is None:
        return None
    masks = np.asarray(Image.open(io.BytesIO(evidence.masks_png))).astype(np.int32)
    values = [
        None if item.copy_of else value for item, value in zip(placed.objects, evidence.object_pixels, strict=True)
    ]
    return measure_coverage(masks, values, meshes, evidence.camera, evidence.camera_to_table)
