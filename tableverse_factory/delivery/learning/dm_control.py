"""Scenes attached to models of dm_control (PyMJCF), which takes free joints only directly below its root.

Each object is attached as a model of its own, on a free joint, and the table as one without; the settings with which
the scene rests become the root's.
"""

import xml.etree.ElementTree as ET
from collections.abc import Mapping
from types import ModuleType
from typing import Any

from tableverse_factory.core.errors import ConfigError
from tableverse_factory.dataset.dataset import Scene
from tableverse_factory.physics.mjcf.load import parse_document

_OPTIONS = ("integrator", "cone", "impratio", "noslip_iterations", "timestep")


def attach_to_dm_control(root: Any, scene: Scene, prefix: str = "") -> dict[str, Any]:
    """Attach a scene to a PyMJCF root, such as that of a `composer.Arena`, with the table frame in its origin.

    Args:
        root: A `dm_control.mjcf.RootElement`. Integrator, cone, impratio, no-slip iterations and timestep become the
            scene's, and several contacts per pair are enabled.
        scene: Of a dataset. Its sky, lamp and camera stay behind.
        prefix: Of the names of the attached models, which are otherwise those of the bodies.

    Returns:
        The frame of the table and of each object, by the body's name.
    """
    try:
        from dm_control import mjcf
    except ImportError:
        raise ConfigError("attach_to_dm_control needs dm_control: pip install dm-control") from None
    document, files = parse_document(scene.files()), scene.files()
    option = document.find("option")
    for name in _OPTIONS:
        if option is not None and name in option.attrib:
            setattr(root.option, name, option.attrib[name])
    root.option.flag.multiccd = "enable"
    return {
        body.attrib["name"]: _attach_body(mjcf, root, document, body, files, prefix)
        for body in document.findall("worldbody/body")
    }


def _attach_body(
    mjcf: ModuleType, root: Any, document: ET.Element, body: ET.Element, files: Mapping[str, bytes], prefix: str
) -> Any:
    """Attach one body of the world; its pose, inertia and free joint belong to the frame of the attachment."""
    model = _extract_body(document, body, prefix + body.attrib["name"])
    named = [element.attrib["file"] for element in model.iter() if "file" in element.attrib]
    assets = {name: files[f"assets/{name}"] for name in named}
    frame = root.attach(mjcf.from_xml_string(ET.tostring(model, encoding="unicode"), assets=assets))
    for name in ("pos", "quat"):
        if name in body.attrib:
            setattr(frame, name, body.attrib[name])
    if any(joint.tag == "freejoint" or joint.get("type") == "free" for joint in body):
        frame.add("freejoint")
    if (inertial := body.find("inertial")) is not None:
        frame.add("inertial", **inertial.attrib)
    return frame


def _extract_body(document: ET.Element, body: ET.Element, name: str) -> ET.Element:
    """Make a document of a body's geoms alone, with the defaults and what they refer to."""
    geoms = body.findall("geom")
    materials = {geom.attrib.get("material") for geom in geoms}
    textures = {m.attrib.get("texture") for m in document.findall("asset/material") if m.attrib["name"] in materials}
    model = ET.Element("mujoco", model=name)
    ET.SubElement(model, "compiler", angle="radian")
    model.extend(document.findall("default"))
    used = {"texture": textures, "material": materials, "mesh": {geom.attrib.get("mesh") for geom in geoms}}
    ET.SubElement(model, "asset").extend(
        asset for asset in document.findall("asset/*") if asset.attrib.get("name") in used.get(asset.tag, ())
    )
    ET.SubElement(model, "worldbody").extend(geoms)
    return model
