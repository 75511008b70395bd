import trimesh

from schemas.codec import encode
from schemas.config import RectifyConfig
from tableverse_factory.geometry.convex.decompose import decompose
from tableverse_factory.geometry.mesh.meshes import from_trimesh


def test_a_cache_that_cannot_be_written_costs_no_scene(tmp_path):
    mesh = from_trimesh(trimesh.creation.annulus(0.02, 0.04, 0.03, sections=12))
    blocked = tmp_path / "a_file"
    blocked.write_bytes(b"not a folder")
    pieces = decompose(mesh, RectifyConfig(), blocked / "cache")
    assert encode(pieces) == encode(decompose(mesh, RectifyConfig(), tmp_path / "cache"))
    assert not list(tmp_path.rglob("*.part"))
