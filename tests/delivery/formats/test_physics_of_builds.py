"""Scenes of a synthetic build in plain MuJoCo: they simulate without a warning, and weigh and turn as predicted.

Inertia is computed a second time, from the exported mesh, by trimesh.
"""

import io
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh

from schemas.config import Config
from schemas.manifest import ImageRow, SceneKind
from schemas.outcome import Done
from tableverse_factory.core.seeding import make_rng
from tableverse_factory.dataset.dataset import Scene
from tableverse_factory.models.services import Services
from tableverse_factory.pipeline import PIPELINES
from tableverse_factory.sources.synthetic.layout import synthesize_layouts

pytestmark = pytest.mark.heavy

SIMULATED_S = 5.0
TOLERANCE = 0.01
MOST_LOST = 0.2
"""Share of the layouts that may be dropped with a reason; what comes out has to be sound."""


@dataclass(frozen=True)
class _Body:
    mass: float
    center: np.ndarray
    inertia: np.ndarray


def build(folder: Path, count: int, seed: int) -> list[Scene]:
    scenes = []
    for path in synthesize_layouts(folder / "in", count, seed):
        item = ImageRow(scene_id=path.stem, kind=SceneKind.LAYOUT, uri=str(path))
        for stage in PIPELINES[SceneKind.LAYOUT]:
            outcome = stage.run(item, Config(), make_rng(0, path.stem, stage.name), Services(folder / "cache"))
            if not isinstance(outcome, Done):
                break
            item = outcome.value
        else:
            scenes.append(Scene(path.stem, {}, dict(item.files)))
    assert len(scenes) >= (1 - MOST_LOST) * count
    return scenes


def check_simulation(model: mujoco.MjModel) -> None:
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, nstep=round(SIMULATED_S / model.opt.timestep))
    assert {kind: warning.number for kind, warning in enumerate(data.warning) if warning.number} == {}
    assert np.isfinite(data.qpos).all()


def check_masses(scene: Scene, model: mujoco.MjModel) -> int:
    """Compares every object; returns how many inertias were computed a second time."""
    meta, compared = scene.meta, 0
    predicted = {verdict["object_id"]: verdict["mass_kg"] for verdict in meta["assessment"]["objects"]}
    free = {model.body(int(model.jnt_bodyid[j])).name for j in range(model.njnt)}
    assert free == set(predicted)
    total = sum(float(model.body(name).mass[0]) for name in free)
    assert total == pytest.approx(sum(predicted.values()), rel=TOLERANCE)
    for entry in meta["objects"]:
        name = entry["object_id"]
        ours = in_body_frame(model, model.body(name).id)
        assert ours.mass == pytest.approx(predicted[name], rel=TOLERANCE)
        theirs = by_trimesh(scene.files()[f"assets/{name}.obj"], predicted[name])
        if theirs is None:
            assert entry["inertia_from"] != "mesh"
            continue
        compared += 1
        size = float(np.sqrt(np.trace(theirs.inertia) / theirs.mass))
        assert np.linalg.norm(ours.center - theirs.center) <= TOLERANCE * size, name
        assert np.abs(ours.inertia - theirs.inertia).max() <= TOLERANCE * np.abs(theirs.inertia).max(), name
    return compared


def in_body_frame(model: mujoco.MjModel, body: int) -> _Body:
    axes = np.zeros(9)
    mujoco.mju_quat2Mat(axes, model.body_iquat[body])
    axes = axes.reshape(3, 3)
    inertia = axes @ np.diag(model.body_inertia[body]) @ axes.T
    return _Body(float(model.body_mass[body]), model.body_ipos[body].copy(), inertia)


def by_trimesh(data: bytes, mass: float) -> _Body | None:
    """None where the mesh is open: then there is no volume to spread the mass over."""
    mesh = trimesh.load(io.BytesIO(data), "obj", process=True, skip_materials=True)
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    if not (mesh.is_watertight and mesh.is_winding_consistent):
        return None
    mesh.density = mass / abs(mesh.volume)
    return _Body(mass, mesh.center_mass, mesh.moment_inertia * np.sign(mesh.volume))


@pytest.mark.parametrize(
    ("count", "seed"), [(1, 38), *(pytest.param(*more, marks=pytest.mark.slow) for more in ((3, 31), (100, 47)))]
)
def test_built_scenes_simulate_and_weigh_as_predicted(count, seed, tmp_path):
    compared = objects = 0
    for scene in build(tmp_path, count, seed):
        model = scene.model()
        check_simulation(model)
        compared += check_masses(scene, model)
        objects += len(scene.meta["objects"])
    assert compared >= 0.8 * objects, "nearly all synthetic meshes are closed"
