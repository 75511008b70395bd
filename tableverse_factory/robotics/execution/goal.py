"""Goal of a trajectory, and the bounds that it has to keep."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from schemas.curation import Relation
from schemas.geometry import Frozen, Pose, TriangleMesh
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.geometry.mesh.meshes import place_mesh
from tableverse_factory.geometry.relations.relations import compute_body_features, relation_holds
from tableverse_factory.physics.mjcf.scene_objects import load_mesh

# Relations in which the reference carries the object
RESTING_RELATIONS = frozenset({Relation.ON, Relation.IN, Relation.INTO, Relation.INSIDE})


@dataclass(frozen=True, slots=True, eq=False)
class Goal(Frozen):
    """Object X in a relation to object Y; `x` and `y` are their true meshes in their own frames, as exported [m]."""

    relation: Relation
    x_id: str
    y_id: str
    x: TriangleMesh
    y: TriangleMesh
    max_disturbed_m: float  # allowed displacement of any other object

    def holds(self, x_pose: Pose, y_pose: Pose) -> bool:
        """Test whether the relation holds between the true bodies at these poses in the table frame."""
        return relation_holds(
            self.relation,
            compute_body_features(place_mesh(self.x, x_pose)),
            compute_body_features(place_mesh(self.y, y_pose)),
        )


def load_goal(files: Mapping[str, bytes], row: Mapping[str, Any], max_disturbed_m: float) -> Goal:
    """Load the goal of a row of tasks/ or trajectories/, of any origin, from the files of its exported scene."""
    x_id, y_id, relation = (str(row.get(key)) for key in ("x_id", "y_id", "relation"))
    if relation not in set(Relation):
        raise InputError(
            f"there is no relation {sanitize_line(relation, 60)!r}; one of {', '.join(Relation)}", "bad_task"
        )
    if x_id == y_id:
        raise InputError(f"{sanitize_line(x_id, 60)!r} cannot be brought into a relation to itself", "bad_task")
    return Goal(Relation(relation), x_id, y_id, load_mesh(files, x_id), load_mesh(files, y_id), max_disturbed_m)
