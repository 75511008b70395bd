"""`evaluate collisions`: planted depths come out in every format, in their order, and at the rates of `bench lccr`."""

import json
import shutil
import tracemalloc

import numpy as np
import pytest
import trimesh
from typer.testing import CliRunner

from schemas.config import Config
from tableverse_factory.cli.main import app
from tableverse_factory.evaluation.bench.lccr import bench_lccr
from tableverse_factory.evaluation.methods.collisions import compute_wilson_interval, measure_method
from tableverse_factory.evaluation.methods.sources import find_scenes
from tests.helpers.known_penetrations import DEPTHS_MM, INNER, ORDER, WRITERS, glb_scene, write_glbs, write_layouts


@pytest.mark.parametrize("kind", WRITERS)
def test_planted_depths_are_found_and_ranked(kind, tmp_path):
    sources = find_scenes(WRITERS[kind](tmp_path / "in"))
    assert [source.format for source in sources] == [kind] * 5
    measured = {s.name: s for s in measure_method("x", sources, 1e-3, tmp_path / "cache").scenes}
    ranked = sorted(measured, key=lambda name: measured[name].depth_m)
    assert tuple(ranked) == ORDER
    assert measured["clean"].meshes == measured["clean"].pieces == ()
    for name, depth in DEPTHS_MM.items():
        if depth > 0:
            assert 1e3 * measured[name].depth_m == pytest.approx(depth, abs=1e-3)
            assert 1e3 * measured[name].piece_depth_m == pytest.approx(depth, abs=1e-3)
            assert {measured[name].meshes[0][:2]} == {("big", "small")}
    assert measured["inside"].depth_m == pytest.approx(INNER, rel=1e-3)
    assert measured["inside"].piece_depth_m > INNER


@pytest.mark.parametrize(("epsilon", "rate"), [(0.0001, 0.8), (0.001, 0.6), (0.005, 0.4), (0.02, 0.2)])
def test_the_rate_follows_epsilon(epsilon, rate, tmp_path):
    method = measure_method("x", find_scenes(write_glbs(tmp_path / "in")), epsilon, None)
    assert method.rate() == rate
    assert method.piece_rate() is None
    low, high = method.interval()
    assert low < rate < high


def test_wilson_at_the_ends():
    assert compute_wilson_interval(0.0, 60) == (0.0, pytest.approx(0.0602, abs=1e-3))
    assert compute_wilson_interval(1.0, 60) == (pytest.approx(0.9398, abs=1e-3), 1.0)


def test_the_command_compares_methods_and_says_what_it_could_not_read(tmp_path):
    layouts, glbs = write_layouts(tmp_path / "a"), write_glbs(tmp_path / "b")
    (glbs / "broken.glb").write_bytes(b"glTF but not really")
    arguments = ["evaluate", "collisions", str(layouts), "--method", f"theirs={glbs}", "--meshes-only", "--json"]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 1
    report = json.loads(result.stdout)
    assert report["epsilon_m"] == 0.0001
    ours, theirs = report["methods"]
    assert (ours["method"], ours["scenes"], ours["collision_rate"]) == ("layouts", 5, 0.8)
    assert (theirs["method"], theirs["scenes"], theirs["measured"], theirs["collision_rate"]) == ("theirs", 6, 5, 0.8)
    by_name = {scene["scene"]: scene for scene in theirs["per_scene"]}
    assert "does not decode" in by_name["broken"]["error"]
    assert by_name["ten"]["meshes"][0] == {"a": "big", "b": "small", "depth_m": pytest.approx(0.01, abs=1e-5)}
    assert by_name["clean"]["colliding"] is False
    shown = CliRunner().invoke(app, arguments[:-1])
    assert "not measured: theirs: broken" in shown.stdout


SOLID = '<geom type="box" size=".05 .05 .05"/>'
DECAL = '<geom type="box" size=".002 .002 .002" pos="0 0 .06" contype="0" conaffinity="0" mass="0"/>'
HIDDEN = SOLID.replace("/>", ' group="3"/>')
FACES = DECAL.replace(".002 .002 .002", ".05 .05 .0002") + DECAL.replace(".002 .002 .002", ".05 .05 .0002").replace(
    "0 0 .06", "0 0 -.06"
)


@pytest.mark.parametrize("extra", ["", DECAL, DECAL.replace("mass", 'group="1" mass'), FACES])
@pytest.mark.parametrize("second", ["<freejoint/>", ""])
@pytest.mark.parametrize("solid", [HIDDEN, pytest.param(SOLID, marks=pytest.mark.slow)])
def test_no_dressing_hides_a_collision(solid, second, extra, tmp_path):
    """Neither what is drawn beside a solid, nor a body that is fixed, nor a group, is a way to a rate of 0."""
    (tmp_path / "a.xml").write_text(
        f'<mujoco><worldbody><body name="a" pos="0 0 .1"><freejoint/>{solid}{extra}</body>'
        f'<body name="b" pos="0.09 0 .1">{second}{solid}{extra}</body>'
        f'<body name="Table" pos="0 0 0">{SOLID}</body></worldbody></mujoco>'
    )
    (scene,) = measure_method("x", find_scenes(tmp_path / "a.xml"), 1e-4, tmp_path / "cache").scenes
    assert (scene.error, scene.objects, scene.left_out) == ("", 2, ("Table",))
    assert scene.depth_m == pytest.approx(0.01, abs=1e-5)
    assert scene.piece_depth_m == pytest.approx(0.01, abs=1e-5)
    verified = CliRunner().invoke(app, ["verify", str(tmp_path / "a.xml"), "--json"])
    assert verified.exit_code == 1
    assert json.loads(verified.stdout)["scenes"][0]["mesh_penetration_m"] == pytest.approx(0.01, abs=1e-5)


@pytest.mark.heavy
def test_a_collider_around_what_is_drawn_is_not_its_shape(tmp_path):
    """A cup closed by the box that it collides with: what stands in it does not lie inside its mesh."""
    cup = trimesh.creation.revolve([[0, 0], [0.05, 0], [0.05, 0.08], [0.049, 0.08], [0.049, 0.001], [0, 0.001]])
    cup.export(tmp_path / "cup.obj")
    (tmp_path / "a.xml").write_text(
        '<mujoco><asset><mesh name="cup" file="cup.obj" inertia="exact"/></asset><worldbody>'
        '<body name="cup"><freejoint/><geom type="mesh" mesh="cup" group="2" contype="0" conaffinity="0"/>'
        '<geom type="box" size=".05 .05 .04" pos="0 0 .04" group="3"/></body>'
        '<body name="egg" pos="0 0 .04"><freejoint/><geom type="sphere" size=".02"/></body></worldbody></mujoco>'
    )
    (scene,) = measure_method("x", find_scenes(tmp_path / "a.xml"), 1e-4, tmp_path / "cache").scenes
    assert scene.depth_m == 0.0
    assert scene.piece_depth_m > 0.01
    verified = CliRunner().invoke(app, ["verify", str(tmp_path / "a.xml"), "--json"])
    assert json.loads(verified.stdout)["scenes"][0]["mesh_penetration_m"] == 0.0


def test_what_lies_in_a_hollow_does_not_collide(tmp_path):
    cup = trimesh.creation.revolve([[0, 0], [0.05, 0], [0.05, 0.08], [0.046, 0.08], [0.046, 0.004], [0, 0.004]])
    cup.apply_transform(trimesh.transformations.rotation_matrix(-1.5707963, [1, 0, 0]))
    scene = trimesh.Scene({"cup": cup, "egg": trimesh.creation.icosphere(2, 0.02)})
    scene.graph.update("egg", matrix=trimesh.transformations.translation_matrix([0, 0.03, 0]), geometry="egg")
    scene.export(tmp_path / "cup.glb")
    assert measure_method("x", find_scenes(tmp_path / "cup.glb"), 1e-4, None).rate() == 0.0


@pytest.mark.parametrize("wrapping", [1, 2])
def test_wrapped_nodes_are_objects_all_the_same(wrapping, tmp_path):
    """Exporters put everything under a root node, or two, that turn or scale it."""
    scene, wrapped = glb_scene("ten"), trimesh.Scene(base_frame="root")
    parent = "root"
    for depth in range(wrapping):
        turn = trimesh.transformations.rotation_matrix(0.7 * (depth + 1), [1, 2, 3])
        wrapped.graph.update(frame_from=parent, frame_to=f"wrap{depth}", matrix=turn)
        parent = f"wrap{depth}"
    for node in scene.graph.nodes_geometry:
        matrix, name = scene.graph.get(node)
        wrapped.add_geometry(
            scene.geometry[name], node_name=node, geom_name=name, parent_node_name=parent, transform=matrix
        )
    wrapped.export(tmp_path / "scene.glb")
    (measured,) = measure_method("x", find_scenes(tmp_path), 1e-4, None).scenes
    assert measured.objects == 2
    assert measured.depth_m == pytest.approx(0.01, abs=1e-5)


@pytest.mark.slow
@pytest.mark.shared
def test_the_same_rates_as_bench_lccr(shared_dir, tmp_path):
    (tmp_path / "layouts").mkdir()
    (tmp_path / "meshes").mkdir()
    for path in sorted((shared_dir / "layouts").glob("*.json"))[1:2]:
        shutil.copy(path, tmp_path / "layouts")
        for entry in json.loads(path.read_text())["objects"]:
            shutil.copy(path.parent / entry["mesh"], tmp_path / "meshes")
    paths = sorted((tmp_path / "layouts").glob("*.json"))
    theirs = bench_lccr(paths, None, Config(), tmp_path / "cache", ["Direct"])["Direct"]
    ours = measure_method("x", find_scenes(tmp_path / "layouts"), 1e-4, tmp_path / "cache").scenes
    assert [scene.depth_m for scene in ours] == theirs.mesh_depths_m
    assert [scene.piece_depth_m for scene in ours] == theirs.piece_depths_m
    assert max(theirs.mesh_depths_m) > 1e-3


def test_a_file_that_leads_round_in_circles_ends(tmp_path):
    """Its nodes are one another's children: refused or read, but in finite time."""
    data = glb_scene("two").export(file_type="glb")
    length = int.from_bytes(data[12:16], "little")
    tree = json.loads(data[20 : 20 + length])
    tree["nodes"][0]["children"] = [1]
    tree["nodes"][1]["children"] = [0, 1]
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    rest = data[20 + length :]
    head = b"glTF" + (2).to_bytes(4, "little") + (20 + len(text) + len(rest)).to_bytes(4, "little")
    (tmp_path / "ring.glb").write_bytes(head + len(text).to_bytes(4, "little") + b"JSON" + text + rest)
    (scene,) = measure_method("x", find_scenes(tmp_path / "ring.glb"), 1e-4, None).scenes
    assert scene.error == "" or "does not decode" in scene.error
    assert scene.objects <= 3
    assert scene.depth_m in (0.0, pytest.approx(0.002, abs=1e-5)), "what is read of it is right"


@pytest.mark.heavy
def test_a_small_file_that_shows_one_mesh_thousands_of_times(tmp_path):
    """Refused before the copies are made: 20 kB would become 6 million triangles."""
    scene = trimesh.Scene()
    scene.add_geometry(trimesh.creation.icosphere(4), node_name="first", geom_name="ball")
    for index in range(1200):
        scene.graph.update(f"n{index}", "first", geometry="ball", matrix=np.eye(4))
    scene.export(tmp_path / "many.glb")
    tracemalloc.start()
    (measured,) = measure_method("x", find_scenes(tmp_path / "many.glb"), 1e-4, None).scenes
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert "at most 5000000" in measured.error
    assert peak < 50e6


def test_a_document_that_is_too_long_is_not_read(tmp_path):
    with (tmp_path / "long.xml").open("wb") as file:
        file.truncate(64 * 1024 * 1024 + 1)
    (measured,) = measure_method("x", find_scenes(tmp_path / "long.xml"), 1e-4, None).scenes
    assert "give a file of at most" in measured.error
