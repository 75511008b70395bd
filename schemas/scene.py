"""Records from the rectified layout to the exported scene."""

from dataclasses import dataclass
from typing import Any

from schemas.curation import Assessment
from schemas.geometry import ConvexPieces, Frozen, Pose
from schemas.objects import PlacedObjects
from schemas.tables import OBJECTS, SCENES, TASKS, TRAJECTORIES, normalize_row

POORLY_COVERED = 0.5  # less of an object's mask than this is worth a remark, and costs points of quality


@dataclass(frozen=True, slots=True, eq=False)
class RectifiedLayout(Frozen):
    """Objects moved apart until nothing touches (LCCR, paper section 3.2).

    Attributes:
        placed: The layout before, objects in a fixed order that all tuples here follow.
        pieces: Convex pieces of each mesh, in the mesh's own frame at scale 1.
        poses: Rectified pose of each object in the table frame.
        groups: Group index of each object after phase 1; the root is group 0.
        penetration_before_m: Deepest pair penetration of the placed layout on the pieces [m].
        method: `lccr`, `joint`, or `partly radial` and `radial` if no joint least motion was found.
    """

    scene_id: str
    placed: PlacedObjects
    pieces: tuple[ConvexPieces, ...]
    poses: tuple[Pose, ...]
    groups: tuple[int, ...]
    penetration_before_m: float
    method: str = "lccr"


@dataclass(frozen=True, slots=True, eq=False)
class SettledScene(Frozen):
    """Layout at rest after a forward simulation.

    Attributes:
        poses: Settled pose of each object in the table frame.
        settle_time_s: Simulated time until rest was measured [s].
    """

    scene_id: str
    rectified: RectifiedLayout
    poses: tuple[Pose, ...]
    settle_time_s: float


@dataclass(frozen=True, slots=True)
class Coverage:
    """How the settled twin, seen from the camera of the photograph, covers the masks that perception found.

    Attributes:
        whole: Share of the pixels of all masks at which the twin shows the object of the mask.
        of_objects: The same of each object's mask, in their order; None for a copy, which has none.
    """

    whole: float
    of_objects: tuple[float | None, ...]

    @property
    def poor(self) -> tuple[int, ...]:
        """Indices of the objects whose masks are covered too little."""
        return tuple(
            index for index, share in enumerate(self.of_objects) if share is not None and share < POORLY_COVERED
        )


@dataclass(frozen=True, slots=True, eq=False)
class CuratedScene(Frozen):
    """Settled scene with the judge's seven outputs, checked against the geometry; no coverage without a photograph."""

    scene_id: str
    settled: SettledScene
    judge: str
    assessment: Assessment
    coverage: Coverage | None = None


@dataclass(frozen=True, slots=True)
class Certificate:
    """Measurements on the exported XML itself.

    Attributes:
        epsilon_m: Depth below which a touch is not counted as a collision [m].
        piece_penetration_before_m: Deepest pair penetration before settling, after LCCR, on the convex pieces [m].
        piece_penetration_m: The same in the exported state [m]; `mesh_penetration_m` on the visual meshes.
        drift_m: Largest displacement of an object over 5 s of further simulation [m].
        drift_rad: Largest rotation of an object over the same time [rad].
        displacement_m: Displacement of each object's centre from where the picture put it [m]; without copies.
        fell: Ids of objects that left the table.
        left_container: Ids of objects that left the container that held them.
        at_rest: Whether drift is within 1 mm and 1 degree for every object and nothing fell.
        colliding: Whether any pair is deeper than `epsilon_m`, on pieces or meshes, in the exported state.
    """

    epsilon_m: float
    piece_penetration_before_m: float
    mesh_penetration_before_m: float
    piece_penetration_m: float
    mesh_penetration_m: float
    drift_m: float
    drift_rad: float
    displacement_m: tuple[tuple[str, float], ...]
    fell: tuple[str, ...]
    left_container: tuple[str, ...]
    at_rest: bool
    colliding: bool


@dataclass(frozen=True, slots=True, eq=False)
class ExportedScene(Frozen):
    """Files and rows of one scene, the rows in normal form (`normalize_row`).

    Attributes:
        files: Tar members, sorted by name, without the scene's folder: `scene.xml`, `assets/…`, `meta.json`,
            `observation/…`, `trajectories/…`.
        scene_row: Columns of scenes/ that the scene itself determines (`schemas.tables.SCENES`).
        trajectory_rows: Rows of trajectories/; none in builds without trajectories.
    """

    scene_id: str
    files: tuple[tuple[str, bytes], ...]
    certificate: Certificate
    scene_row: dict[str, Any]
    object_rows: tuple[dict[str, Any], ...]
    task_rows: tuple[dict[str, Any], ...]
    trajectory_rows: tuple[dict[str, Any], ...] = ()

    def __post_init__(self) -> None:
        row = {**self.scene_row, "scene_id": self.scene_id}
        object.__setattr__(self, "scene_row", normalize_row(row, SCENES))
        for name, schema in (("object_rows", OBJECTS), ("task_rows", TASKS), ("trajectory_rows", TRAJECTORIES)):
            object.__setattr__(self, name, tuple(normalize_row(row, schema) for row in getattr(self, name)))
