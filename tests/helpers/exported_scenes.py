"""Small exported scenes with hostile labels and odd poses, as datasets."""

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import trimesh

from schemas.config import Config
from schemas.geometry import TriangleMesh
from schemas.outcome import Done
from schemas.scene import ExportedScene
from tableverse_factory.dataset.dataset import Scene
from tableverse_factory.geometry.mesh.meshes import from_trimesh
from tableverse_factory.models.services import Services
from tableverse_factory.stages.export.export import export
from tests.helpers.simple_scenes import Solid, as_settled, box, curated, cylinder, layout

HOSTILE = "<b a='1' c=\"2\">&amp;]]></label><!-- 杯子 ✓"


@dataclass(frozen=True)
class _Loose:
    """A scene outside a dataset."""

    scene: ExportedScene
    row: dict[str, object] = field(default_factory=dict)

    def open(self) -> Scene:
        return Scene(self.scene.scene_id, self.row, dict(self.scene.files))


def colored(mesh: TriangleMesh, rgb: tuple[int, int, int]) -> TriangleMesh:
    return TriangleMesh(mesh.vertices, mesh.faces, np.tile(np.array(rgb, dtype=np.uint8), (len(mesh.vertices), 1)))


def offset(mesh: TriangleMesh, by: tuple[float, float, float]) -> TriangleMesh:
    """The same shape in a frame that is not its middle."""
    return TriangleMesh(mesh.vertices + np.array(by), mesh.faces, mesh.vertex_colors)


def solids() -> list[Solid]:
    lying = (math.cos(math.pi / 4), math.sin(math.pi / 4), 0.0, 0.0)
    turned = (math.cos(0.4), 0.0, 0.0, math.sin(0.4))
    wedge = from_trimesh(trimesh.convex.convex_hull(np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.06, 0], [0, 0, 0.05]])))
    return [
        Solid(colored(box(0.1, 0.08, 0.04), (200, 40, 40)), (0.0, 0.0, 0.02), HOSTILE, quaternion=turned),
        Solid(offset(cylinder(0.03, 0.1), (0.02, 0.01, 0.03)), (0.15, -0.1, 0.02), "can", quaternion=lying),
        Solid(colored(wedge, (20, 160, 60)), (-0.2, 0.05, 0.0), "cheese", scale=1.25),
    ]


def exported(scene_id: str = "scene") -> Scene:
    """The scene as a consumer opens it."""
    curated_scene = curated(as_settled(layout(solids(), scene_id=scene_id)))
    outcome = export(curated_scene, Config(), np.random.default_rng(0), Services(Path("unused")))
    assert isinstance(outcome, Done), outcome
    return _Loose(outcome.value).open()
