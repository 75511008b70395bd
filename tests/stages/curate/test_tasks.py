"""Tasks of many scenes before a second, independent referee."""

import json

import numpy as np
import pytest
import trimesh

from schemas.config import Config, ObserveConfig
from schemas.geometry import TriangleMesh
from schemas.scene import SettledScene
from tableverse_factory.core.seeding import make_rng
from tableverse_factory.geometry.mesh.meshes import from_trimesh, place_mesh, to_trimesh
from tableverse_factory.models.services import Services
from tableverse_factory.sources.layout_file import read_layout_file, read_layout_meshes
from tableverse_factory.sources.synthetic.scene import arrange_scene
from tableverse_factory.stages.curate.curate import curate
from tests.helpers.curate_scenes import BLUE, RED, WHITE, Thing, ball, box, cylinder, kitchen, settled, vessel
from tests.helpers.task_referee import faults

pytestmark = pytest.mark.heavy

_KINDS = (
    lambda s, c: ("mug", vessel(0.035 * s, 0.09 * s, color=c)),
    lambda s, c: ("bowl", vessel(0.075 * s, 0.055 * s, color=c)),
    lambda s, c: ("plate", cylinder(0.1 * s, 0.012 * s, c)),
    lambda s, c: ("lemon", ball(0.027 * s, c)),
    lambda s, c: ("soup can", cylinder(0.033 * s, 0.1 * s, c)),
    lambda s, c: ("sugar box", box(0.045 * s, 0.09 * s, 0.17 * s, c)),
    lambda s, c: ("book", box(0.15 * s, 0.2 * s, 0.03 * s, c)),
    lambda s, c: ("marker", box(0.14 * s, 0.015 * s, 0.015 * s, c)),
)


def random_scene(seed: int, sizes: tuple[float, ...] = (0.8, 0.95, 1.15)) -> SettledScene:
    """Without sizes, any from 0.8 to 1.15: no two things alike cost more."""
    rng = np.random.default_rng(seed)
    cells = rng.permutation(12)[: rng.integers(3, 11)]
    things = []
    for cell in cells:
        color = (RED, BLUE, WHITE)[rng.integers(3)]
        label, mesh = _KINDS[rng.integers(len(_KINDS))](rng.choice(sizes) if sizes else rng.uniform(0.8, 1.15), color)
        x, y = 0.26 * (cell % 4) - 0.39, 0.26 * (cell // 4) - 0.26
        things.append(
            Thing(label, mesh, x + rng.uniform(-0.02, 0.02), y + rng.uniform(-0.02, 0.02), 0.0, rng.uniform(0, 3))
        )
    return settled(things, (0.7, 0.5), f"random_{seed}")


def judge_and_referee(scene: SettledScene, tmp_path) -> tuple[int, int, list[str]]:
    """Number of tasks, of relations, and the referee's faults."""
    outcome = curate(scene, Config(), make_rng(0, scene.scene_id, "curate"), Services(tmp_path))
    assessment = outcome.value.assessment
    placed = scene.rectified.placed.objects
    meshes = {
        o.object_id: to_trimesh(place_mesh(o.mesh, pose, o.scale)) for o, pose in zip(placed, scene.poses, strict=True)
    }
    phrases = {o.object_id: o.distinguishing_phrases for o in assessment.objects}
    flat = [phrase for own in phrases.values() for phrase in own]
    found = faults(assessment.tasks, meshes)
    found += [f"a phrase repeats: {phrase}" for phrase in set(flat) if flat.count(phrase) > 1]
    found += [
        t.instruction for t in assessment.tasks if not any(f"Pick up {p} and" in t.instruction for p in phrases[t.x_id])
    ]
    found += [f"refused: {t.instruction}" for t in assessment.tasks if not t.accepted]
    return len(assessment.tasks), len({t.relation for t in assessment.tasks}), found


@pytest.mark.parametrize("seeds", [range(2), pytest.param(range(2, 8), marks=pytest.mark.slow)])
def test_tasks_of_random_tables_hold_every_constraint(tmp_path, seeds):
    total = 0
    for seed in seeds:
        tasks, relations, found = judge_and_referee(random_scene(seed), tmp_path)
        assert not found
        assert relations >= min(3, tasks)
        total += tasks
    assert total > 10 * len(seeds)


def synthetic_scene(number: int) -> SettledScene:
    """A table of `tableverse synth` at rest: some fifty kinds of things, also inside and on one another."""
    placed, half_xy = arrange_scene(make_rng(11, f"synth_{number:06d}", "synth"), "tasks")
    things = []
    for item in placed:
        mesh = place_mesh(item.model.mesh, item.pose)
        colors = np.clip(item.model.texture(item.model.mesh.vertices), 0, 255).astype(np.uint8)
        painted = TriangleMesh(mesh.vertices, mesh.faces, colors)
        things.append(Thing(item.model.label, painted, z=float(mesh.vertices[:, 2].min())))
    return settled(things, half_xy, f"synth_{number:06d}")


def test_tasks_of_synthetic_tables_hold_every_constraint(tmp_path):
    tasks, relations, found = judge_and_referee(synthetic_scene(0), tmp_path)
    assert not found
    assert relations >= 3
    assert tasks >= 5


@pytest.mark.slow
def test_tasks_of_a_hundred_synthetic_tables(tmp_path):
    found = [judge_and_referee(synthetic_scene(number), tmp_path) for number in range(100)]
    assert [fault for _, _, faults_of_one in found for fault in faults_of_one] == []
    assert sum(tasks for tasks, _, _ in found) >= 500
    assert sum(relations >= 3 for _, relations, _ in found) >= 95


def test_tasks_of_the_kitchen_hold_every_constraint(tmp_path):
    assert judge_and_referee(kitchen(), tmp_path)[2] == []


@pytest.mark.slow
def test_five_hundred_tasks_over_a_hundred_tables(tmp_path):
    found = [judge_and_referee(random_scene(seed, ()), tmp_path) for seed in range(100)]
    assert sum(tasks for tasks, _, _ in found) >= 500
    assert [fault for _, _, faults_of_one in found for fault in faults_of_one] == []
    assert sum(relations >= 3 for _, relations, _ in found) >= 95


@pytest.mark.slow  # the tests above hold the constraints on other tables
@pytest.mark.shared
def test_tasks_of_scanned_clutter_hold_every_constraint(shared_dir, tmp_path):
    for number in (0,):
        scene = clutter(shared_dir, number)
        tasks, relations, found = judge_and_referee(scene, tmp_path)
        assert not found
        assert tasks >= 5
        assert relations >= 3


def clutter(shared_dir, number: int) -> SettledScene:
    """A layout of scanned objects at the poses in which they truly rest."""
    name = f"clutter_{number:03d}.json"
    uri = str(shared_dir / "layouts" / name)
    layout = read_layout_file(uri)
    meshes = read_layout_meshes(uri, layout, ObserveConfig())
    truth = json.loads((shared_dir / "layouts" / "truth" / name).read_text())
    things = []
    for item in layout.objects:
        pose = trimesh.transformations.quaternion_matrix(truth[item.id]["quaternion_wxyz"])
        pose[:3, 3] = truth[item.id]["position"]
        solid = to_trimesh(meshes[item.mesh])
        solid.apply_transform(pose)
        things.append(Thing(item.label, from_trimesh(solid), z=float(solid.bounds[0, 2])))
    return settled(things, (0.6, 0.5), name)
