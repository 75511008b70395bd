"""GLB before the validator of those who wrote the standard."""

import json
import shutil
import subprocess

import pytest

from tableverse_factory.delivery.formats.extract import extract_scene
from tests.helpers.exported_scenes import exported

VALIDATE = """
const validator = require("gltf-validator");
const data = new Uint8Array(require("fs").readFileSync(process.argv[1]));
validator.validateBytes(data).then((report) => console.log(JSON.stringify(report.issues)));
"""


@pytest.mark.slow
def test_khronos_finds_no_error_and_no_warning(tmp_path):
    """Run with gltf-validator 2.0.0-dev.3.10 on Node 20, found by NODE_PATH."""
    node = shutil.which("node")
    if node is None or subprocess.run([node, "-e", 'require("gltf-validator")'], capture_output=True).returncode:
        pytest.skip("Node or its package gltf-validator is not installed")
    extract_scene(exported(), tmp_path / "scene", "glb")
    command = [node, "-e", VALIDATE, str(tmp_path / "scene/scene.glb")]
    issues = json.loads(subprocess.run(command, capture_output=True, check=True).stdout)
    assert (issues["numErrors"], issues["numWarnings"]) == (0, 0), issues["messages"]
