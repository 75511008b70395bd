"""Scenes in robosuite: every body is an object of the task, written as the XML file that robosuite loads objects from.

robosuite reads these files, with their meshes and textures, again at every hard reset.
"""

import xml.etree.ElementTree as ET
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from schemas.geometry import Vector3
from tableverse_factory.core.errors import ConfigError, InputError
from tableverse_factory.core.storage.files import write_atomic
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.dataset.dataset import Scene
from tableverse_factory.delivery.formats.folders import check_body_name
from tableverse_factory.geometry.math.transforms import multiply_quaternions, quaternion_about_z, rotation_matrix
from tableverse_factory.physics.mjcf.load import parse_document

_OPTIONS = ("integrator", "cone", "impratio", "noslip_iterations")
_GROUPS = {"collision": "0", "visual": "1"}  # robosuite tells contact from looks by the group


def add_to_robosuite(
    task: Any,
    scene: Scene,
    folder: str | Path,
    position: tuple[float, float, float] = (0.0, 0.0, 0.8),
    yaw_rad: float = -np.pi / 2,
    prefix: str = "",
) -> dict[str, Any]:
    """Add a scene to a robosuite `Task`, with the settings with which it rests: in `_load_model` of an environment.

    Integrator, cone, impratio and no-slip iterations of the task become the scene's, and several contacts per pair are
    enabled. The timestep is robosuite's (`macros.SIMULATION_TIMESTEP`, 0.002 s), which must not exceed the scene's.

    Args:
        task: To add to, of an arena without a table.
        scene: Of a dataset. Its sky, lamp and camera stay behind.
        folder: Where the objects' files are written, below the scene's id.
        position: Of the table frame in the world, z up [m].
        yaw_rad: Turn of the table frame about the vertical [rad]; by default the table's near edge faces -x, where
            robosuite's arms stand.
        prefix: Of the objects' names, and so of their observables; scenes added to one task need different ones.

    Returns:
        The `MujocoXMLObject` of the table and of each object, by the body's name in the scene; the task has them too.

    Raises:
        ConfigError: if robosuite is not installed, its timestep is longer than the scene's, or the task has a name
            of the scene already.
        InputError: `bad_mjcf` if the scene names files that are not its own, or classes that this program does not
            write; `bad_name` if a body cannot be a file.
    """
    try:
        from robosuite import macros
        from robosuite.models.objects import MujocoXMLObject
    except ImportError:
        raise ConfigError("add_to_robosuite needs robosuite: pip install robosuite") from None
    document = parse_document(scene.files())
    timestep = min((float(its.get("timestep", 0.002)) for its in document.findall("option")), default=0.002)
    if timestep < macros.SIMULATION_TIMESTEP:
        raise ConfigError(
            f"scene {scene.scene_id} rests with steps of {timestep:g} s, and robosuite's take "
            f"{macros.SIMULATION_TIMESTEP:g} s: set robosuite.macros.SIMULATION_TIMESTEP"
        )
    _check_names(document, scene)
    paths = _write_objects(document, scene, Path(folder).absolute() / scene.scene_id)
    objects = {}
    for body in document.findall("worldbody/body"):
        name, joints = body.attrib["name"], "default" if body.find("joint") is not None else None
        bare = body.find("geom[@class='visual']") is None  # as the table: what it touches with is what is seen
        added = MujocoXMLObject(str(paths[name]), f"{prefix}{name}", joints=joints, duplicate_collision_geoms=bare)
        added.get_obj().attrib.update(_compute_pose(body, np.array(position), yaw_rad))
        objects[name] = added
    names = {its for added in objects.values() for its in _list_names(added.root)}
    if clash := sorted(_list_names(task.root) & names):
        raise ConfigError(f"prefix {prefix!r}: the task has a {' called '.join(clash[0])} already; give another")
    task.merge_objects(list(objects.values()))
    task.mujoco_objects.extend(objects.values())
    _copy_options(document, task.root.find("option"))
    return objects


def observe_objects(env: Any, objects: Iterable[Any]) -> dict[str, Any]:
    """Make observables of what moves: `NAME_pos` [m] and `NAME_quat` (xyzw) in the world, as parts of `object-state`.

    Add them to what `_setup_observables` of a robosuite environment returns.
    """
    from robosuite.utils.observables import Observable

    return {
        f"{its.name}_{kind}": Observable(f"{its.name}_{kind}", read, sampling_rate=env.control_freq)
        for its in objects
        if its.joints
        for kind, read in _make_sensors(env, its.root_body).items()
    }


def _make_sensors(env: Any, body: str) -> dict[str, Any]:
    from robosuite.utils.observables import sensor
    from robosuite.utils.transform_utils import convert_quat

    number = env.sim.model.body_name2id(body)

    def read_position(_cache: Any) -> Any:
        return np.array(env.sim.data.body_xpos[number])

    def read_quaternion(_cache: Any) -> Any:
        return convert_quat(np.array(env.sim.data.body_xquat[number]), to="xyzw")

    as_object = sensor(modality="object")
    return {"pos": as_object(read_position), "quat": as_object(read_quaternion)}


def _list_names(root: ET.Element) -> set[tuple[str, str]]:
    """List kind and name of all that has one. Of assets with one name, robosuite would keep the first in silence."""
    return {(its.tag, its.attrib["name"]) for its in root.iter() if "name" in its.attrib}


def _copy_options(document: ET.Element, option: ET.Element) -> None:
    """Copy what lets a scene rest into the options of a task."""
    own = {name: value for its in document.findall("option") for name, value in its.attrib.items()}
    option.attrib.update({name: own[name] for name in _OPTIONS if name in own})
    for flag in option.findall("flag") or [ET.SubElement(option, "flag")]:
        flag.set("multiccd", "enable")


def _check_names(document: ET.Element, scene: Scene) -> None:
    """Check what becomes a path, or a group of robosuite: foreign scenes may hold anything."""
    files = scene.files()
    for name in (value for its in document.iter() for key, value in its.attrib.items() if key.startswith("file")):
        if f"assets/{name}" not in files:  # MuJoCo would look for it on the disk
            called = sanitize_line(name, 80)
            raise InputError(f"scene.xml names {called!r}, which is none of its files", "bad_mjcf")
    for body in document.findall("worldbody/body"):
        check_body_name(body.get("name", ""))
    for default in document.findall("default/default"):
        if default.get("class") not in _GROUPS:
            called = sanitize_line(default.get("class", ""), 80)
            raise InputError(f"scene.xml has the class {called!r}: only {' and '.join(_GROUPS)} are known", "bad_mjcf")


def _write_objects(document: ET.Element, scene: Scene, folder: Path) -> dict[str, Path]:
    """Write a file per body and all assets, where they are not there yet. Returns the paths by the bodies' names."""
    paths = {body.attrib["name"]: folder / f"{body.attrib['name']}.xml" for body in document.findall("worldbody/body")}
    written = {folder / name: data for name, data in scene.files().items() if name.startswith("assets/")}
    for body in document.findall("worldbody/body"):
        written[paths[body.attrib["name"]]] = ET.tostring(_make_object_document(document, body))
    for path, data in written.items():
        if not path.exists() or path.read_bytes() != data:
            write_atomic(path, data)
    return paths


def _make_object_document(document: ET.Element, body: ET.Element) -> ET.Element:
    """Make a document of one body in the form that robosuite expects, with the assets that it names."""
    geoms = body.findall("geom")
    materials = {geom.get("material") for geom in geoms}
    textures = {its.get("texture") for its in document.findall("asset/material") if its.get("name") in materials}
    used = {"texture": textures, "material": materials, "mesh": {geom.get("mesh") for geom in geoms}}
    made = ET.Element("mujoco", model=body.attrib["name"])
    defaults, asset = ET.SubElement(made, "default"), ET.SubElement(made, "asset")
    for default in document.findall("default/default"):
        kept = ET.SubElement(defaults, "default", default.attrib)
        group = _GROUPS[default.attrib["class"]]
        kept.extend(ET.Element("geom", its.attrib | {"group": group}) for its in default.findall("geom"))
    for its in document.findall("asset/*"):
        if its.get("name") in used.get(its.tag, ()):
            path = {"file": f"assets/{its.attrib['file']}"} if "file" in its.attrib else {}
            ET.SubElement(asset, its.tag, its.attrib | path)
    outer = ET.SubElement(ET.SubElement(made, "worldbody"), "body")
    inner = ET.SubElement(outer, "body", name="object")
    inner.extend(body.findall("inertial"))
    for geom in geoms:  # robosuite gives names, and the class the group
        ET.SubElement(inner, "geom", {key: value for key, value in geom.attrib.items() if key not in ("name", "group")})
    return made


def _compute_pose(body: ET.Element, position: Vector3, yaw_rad: float) -> dict[str, str]:
    """Compute the pose of a body in the world, as attributes."""
    turn = quaternion_about_z(yaw_rad)
    own_position = np.array([float(its) for its in body.get("pos", "0 0 0").split()])
    own_turn = np.array([float(its) for its in body.get("quat", "1 0 0 0").split()])
    pose = {"pos": position + rotation_matrix(turn) @ own_position, "quat": multiply_quaternions(turn, own_turn)}
    return {name: " ".join(map(repr, value.tolist())) for name, value in pose.items()}
