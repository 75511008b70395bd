"""Newton reads a scene's own files only."""

import pytest
import trimesh

from tableverse_factory import add_to_newton
from tableverse_factory.core.errors import InputError
from tableverse_factory.dataset.scene import Scene
from tests.helpers.exported_scenes import exported


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_a_scene_that_names_other_files_is_refused(tmp_path):
    """Run with newton 1.8.0 and MuJoCo 3.17."""
    newton = pytest.importorskip("newton", reason="installed where it is tested")
    foreign = tmp_path / "foreign.obj"
    trimesh.creation.box((0.5, 0.5, 0.5)).export(foreign)
    own, builder = exported(), newton.ModelBuilder()
    files = own.files() | {"scene.xml": own.xml.replace("obj_000_piece_00.obj", str(foreign)).encode()}
    with pytest.raises(InputError, match="which is none of its files"):
        add_to_newton(builder, Scene(own.scene_id, {}, files))
    assert builder.shape_count == 0
    add_to_newton(builder, own)
    assert builder.body_count == 4, "the table too"
