"""MuJoCo's own XML, made exact and readable by older releases."""

import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence

import numpy as np

from schemas.geometry import Pose
from tableverse_factory.physics.mjcf.inertia import MassProperties


def make_portable_xml(xml: str, bodies: Mapping[str, tuple[Pose, MassProperties]]) -> str:
    """Restore what `MjSpec.to_xml` loses and remove what only the newest MuJoCo reads.

    Poses and inertias are written in full: MuJoCo writes six digits, which moves far poses by micrometres, and leaves
    its compiler's rounding noise as the pose of every mesh geom, whose frame is the body's own. The colour space of a
    texture is always `auto`, which MuJoCo 3.3 does not know; several contacts per pair of pieces, which stable rest
    needs, are the default of MuJoCo 4 alone. Other readers of MJCF take an omitted damping ratio of contacts for 0.
    """
    root = ET.fromstring(xml)  # noqa: S314 - written by MuJoCo a moment ago
    find_or_add_child(find_or_add_child(root, "option"), "flag").set("multiccd", "enable")
    for texture in root.iter("texture"):
        texture.attrib.pop("colorspace", None)
    for geom in root.iter("geom"):
        if len(solref := geom.get("solref", "").split()) == 1:
            geom.set("solref", f"{solref[0]} 1")
    for element in root.iter("body"):
        if (name := element.get("name", "")) in bodies:
            _write_body(element, *bodies[name])
    ET.indent(root)
    return ET.tostring(root, encoding="unicode") + "\n"


def _write_body(element: ET.Element, pose: Pose, properties: MassProperties) -> None:
    element.set("pos", _numbers(pose.position))
    element.set("quat", _numbers(pose.quaternion_wxyz))
    i = properties.inertia
    inertial = find_or_add_child(element, "inertial")
    inertial.attrib.clear()
    inertial.set("pos", _numbers(properties.center))
    inertial.set("mass", _numbers([properties.mass_kg]))
    inertial.set("fullinertia", _numbers([i[0, 0], i[1, 1], i[2, 2], i[0, 1], i[0, 2], i[1, 2]]))
    for geom in element.iter("geom"):
        geom.attrib.pop("pos", None)
        geom.attrib.pop("quat", None)


def find_or_add_child(parent: ET.Element, tag: str) -> ET.Element:
    """Find the element's child of this tag, or add one."""
    found = parent.find(tag)
    return ET.SubElement(parent, tag) if found is None else found


def _numbers(values: Sequence[float] | np.ndarray) -> str:
    return " ".join(f"{float(value):.15g}" for value in values)
