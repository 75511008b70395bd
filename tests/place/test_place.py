from pathlib import Path

import numpy as np

from schemas.config import Config
from schemas.geometry import TriangleMesh
from schemas.objects import PerceivedObject, PerceivedObjects, PlacedObjects
from schemas.outcome import Done, Dropped, Outcome
from tableverse_factory.bench.completion import seen_alone
from tableverse_factory.geometry.meshes import from_trimesh, placed_mesh, to_trimesh
from tableverse_factory.place.place import place
from tableverse_factory.services import Services


def run(scene: PerceivedObjects) -> Outcome[PlacedObjects]:
    return place(scene, Config(), np.random.default_rng(0), Services(Path("unused")))


def only(scene: PerceivedObjects) -> TriangleMesh:
    outcome = run(scene)
    assert isinstance(outcome, Done), outcome
    item = outcome.value.objects[0]
    return placed_mesh(item.mesh, item.pose, item.scale)


def test_a_box_keeps_its_size_and_stands_on_the_table() -> None:
    import trimesh

    truth = trimesh.creation.box((0.16, 0.06, 0.213))
    truth.apply_translation((0, 0, 0.213 / 2))
    for view in (0, 1):
        mesh = only(seen_alone(from_trimesh(truth), view, np.random.default_rng(0)))
        assert to_trimesh(mesh).is_watertight
        assert abs(mesh.vertices[:, 2].min()) < 5e-4
        np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0)[2], 0.213, atol=3e-3)


def test_too_few_points_leave_the_object_out_with_a_reason() -> None:
    import trimesh

    truth = trimesh.creation.box((0.1, 0.1, 0.1))
    scene = seen_alone(from_trimesh(truth), 0, np.random.default_rng(0))
    item = scene.objects[0]
    few = PerceivedObject("obj_000", 1, "object", 1.0, item.points_camera[:5], item.colors[:5])
    outcome = run(
        PerceivedObjects("s", scene.observation, scene.camera_to_table, scene.table, scene.instance_ids, (few,), "t")
    )
    assert isinstance(outcome, Dropped)
    assert outcome.reason == "nothing_placed"
    assert "5 points" in outcome.detail
