"""What a trajectory is to achieve, and the bounds that it has to keep on the way."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from schemas.curation import Relation
from schemas.geometry import Frozen, Pose, TriangleMesh
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.geometry.mesh.meshes import placed_mesh
from tableverse_factory.geometry.relations.relations import body_of, holds
from tableverse_factory.physics.mjcf.scene_objects import mesh_of

RESTING_RELATIONS = frozenset({Relation.ON, Relation.IN, Relation.INTO, Relation.INSIDE})
"""In these the reference carries the object in the end."""


@dataclass(frozen=True, slots=True, eq=False)
class Goal(Frozen):
    """Object X in a relation to object Y.

    Attributes:
        relation: One of the ten.
        x_id: Of the object that is carried.
        y_id: Of the reference.
        x: True mesh of X in its own frame, as exported [m].
        y: The same of Y.
        max_disturbed_m: Largest displacement that any other object may suffer [m].
    """

    relation: Relation
    x_id: str
    y_id: str
    x: TriangleMesh
    y: TriangleMesh
    max_disturbed_m: float

    def holds(self, x_pose: Pose, y_pose: Pose) -> bool:
        """Whether the relation holds between the true bodies at these poses in the table frame."""
        return holds(self.relation, body_of(placed_mesh(self.x, x_pose)), body_of(placed_mesh(self.y, y_pose)))


def goal_of(files: Mapping[str, bytes], row: Mapping[str, Any], max_disturbed_m: float) -> Goal:
    """The goal of a task, from the exported scene.

    Args:
        files: Of the scene by name; `assets/…` are read.
        row: With `relation`, `x_id` and `y_id`: of tasks/ or of trajectories/.
        max_disturbed_m: As in `Goal` [m].

    Raises:
        InputError: `bad_task` if the row names no relation, or one object twice; `bad_scene` if the scene does not hold
            one of the objects.
        GeometryError: if a mesh does not decode.
    """
    x_id, y_id, relation = (str(row.get(key)) for key in ("x_id", "y_id", "relation"))
    if relation not in set(Relation):
        raise InputError(
            f"there is no relation {sanitize_line(relation, 60)!r}; one of {', '.join(Relation)}", "bad_task"
        )
    if x_id == y_id:
        raise InputError(f"{sanitize_line(x_id, 60)!r} cannot be brought into a relation to itself", "bad_task")
    return Goal(Relation(relation), x_id, y_id, mesh_of(files, x_id), mesh_of(files, y_id), max_disturbed_m)
