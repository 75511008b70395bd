"""URDF: a file per object and support, and one of the whole scene with every object on a floating joint.

Readers that know no floating joints, such as Bullet, load the files one by one, at the poses of `poses.json`. Meshes
are OBJ files under `meshes/`. Labels and friction, which URDF lacks, are in extra elements (`label`, Bullet's `contact`
and Drake's `drake:proximity_properties`) that other readers ignore.
"""

import json
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

from schemas.geometry import Matrix3, Pose, TriangleMesh
from schemas.identity import make_file_stem
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.png import encode_png
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.delivery.formats.model_contents import ModelContents, ModelObject, VisualMesh
from tableverse_factory.geometry.math.aabb import aabb
from tableverse_factory.geometry.math.transforms import rotation_matrix
from tableverse_factory.physics.mjcf.obj_assets import Appearance, encode_obj

MESHES = "meshes"
WORLD = "world"
_FLAT_M = 1e-7
_DRAKE_MODULUS_PA = "1e7"  # Drake's own default, which its parser wants to be told


def encode_urdf(contents: ModelContents, labels: Mapping[str, str]) -> dict[str, bytes]:
    """Encode `scene.urdf`, `<object>.urdf` for each object, and their meshes, by path; `labels` are untrusted text."""
    files: list[tuple[str, bytes]] = []
    scene = _make_robot("scene")
    ET.SubElement(scene, "link", name=WORLD)
    _check_unique_names("links", [WORLD, *map(_name_link, (*contents.still, *contents.objects))])
    for content in (*contents.still, *contents.objects):
        moves = content in contents.objects
        link, meshes = _build_link(content, moves)
        files += meshes
        scene.append(link)
        scene.append(_build_joint(content, "floating" if moves else "fixed"))
        alone = _make_robot(content.name)
        alone.append(link)
        if moves and (label := labels.get(content.name)) is not None:
            for root in (alone, scene):
                ET.SubElement(root, "label", link=content.name).text = label
        files.append((f"{make_file_stem(_name_link(content))}.urdf", _serialize(alone)))
    files.append(("scene.urdf", _serialize(scene)))
    files.append(("poses.json", _encode_poses(contents)))
    _check_unique_names("files", [name for name, _ in files])
    return dict(files)


def _check_unique_names(what: str, names: Sequence[str]) -> None:
    """Refuse names that differ only in case, or objects named like another's file."""
    counts = Counter(name.lower() for name in names)
    if doubled := [sanitize_line(name, 100) for name, count in counts.items() if count > 1]:
        called = ", ".join(doubled[:3])
        raise InputError(f"two {what} of the URDF would be called {called}: rename an object", "bad_name")


def _make_robot(name: str) -> ET.Element:
    robot = ET.Element("robot", {"name": name, "xmlns:drake": "http://drake.mit.edu"})
    # For MuJoCo alone: meshes are where they are said to be, and a body without a joint keeps its mass.
    compiler = {"strippath": "false", "fusestatic": "false", "discardvisual": "false"}
    ET.SubElement(ET.SubElement(robot, "mujoco"), "compiler", compiler)
    return robot


def _build_link(content: ModelObject, moves: bool) -> tuple[ET.Element, list[tuple[str, bytes]]]:
    link = ET.Element("link", name=_name_link(content))
    stem = make_file_stem(content.name)
    if moves:
        link.append(_build_inertial(content))
    files: list[tuple[str, bytes]] = []
    for index, look in enumerate(content.looks):
        name = stem if index == 0 else f"{stem}_look_{index:02d}"
        files += [(f"{MESHES}/{file}", data) for file, data in encode_obj_files(look, name).items()]
        visual = _build_shape("visual", name)
        if look.mesh.texture is None:
            material = ET.SubElement(visual, "material", name=name)
            ET.SubElement(material, "color", rgba=_format_numbers([*(np.array(look.color) / 255.0), 1.0]))
        link.append(visual)
    for index, hull in enumerate(content.hulls):
        name = f"{stem}_piece_{index:02d}"
        if is_box(hull):  # exact everywhere; Bullet rounds convex meshes by a margin
            shape = _build_box(name, hull)
        else:
            files.append((f"{MESHES}/{name}.obj", encode_obj(hull)))
            shape = _build_shape("collision", name)
        shape.append(_build_drake_contact(content))
        link.append(shape)
    link.append(_build_contact(content))
    return link, files


def _name_link(content: ModelObject) -> str:
    """Name the link after its object, except for the world body, as the root has that name."""
    return "surroundings" if content.name == WORLD else content.name


def _build_inertial(content: ModelObject) -> ET.Element:
    inertial = ET.Element("inertial")
    ET.SubElement(inertial, "origin", xyz=_format_numbers(content.center), rpy="0 0 0")
    ET.SubElement(inertial, "mass", value=_format_numbers([content.mass_kg]))
    i = content.inertia
    keys = {"ixx": i[0, 0], "ixy": i[0, 1], "ixz": i[0, 2], "iyy": i[1, 1], "iyz": i[1, 2], "izz": i[2, 2]}
    ET.SubElement(inertial, "inertia", {key: _format_numbers([value]) for key, value in keys.items()})
    return inertial


def _build_contact(content: ModelObject) -> ET.Element:
    """Build Bullet's element. Bullet multiplies the sliding frictions of a pair, where MuJoCo takes the larger."""
    spin, roll = content.spin_roll
    values = {"lateral_friction": content.friction**0.5, "spinning_friction": spin, "rolling_friction": roll}
    contact = ET.Element("contact")
    for name, value in values.items():
        ET.SubElement(contact, name, value=_format_numbers([value]))
    return contact


def _build_drake_contact(content: ModelObject) -> ET.Element:
    """Build Drake's element: patches of contact, as things do not rest on its single points."""
    contact = ET.Element("drake:proximity_properties")
    ET.SubElement(contact, "drake:compliant_hydroelastic")
    ET.SubElement(contact, "drake:hydroelastic_modulus", value=_DRAKE_MODULUS_PA)
    for name in ("mu_dynamic", "mu_static"):
        ET.SubElement(contact, f"drake:{name}", value=_format_numbers([content.friction]))
    return contact


def _encode_poses(contents: ModelContents) -> bytes:
    """Encode the poses of the files' frames in the world [m], quaternions as Bullet and ROS have them."""
    poses = [
        {
            "urdf": f"{make_file_stem(_name_link(content))}.urdf",
            "moves": moves,
            "position": content.pose.position.tolist(),
            "quaternion_xyzw": np.roll(content.pose.quaternion_wxyz, -1).tolist(),
        }
        for moves, group in ((False, contents.still), (True, contents.objects))
        for content in group
    ]
    return (json.dumps(poses, indent=1) + "\n").encode()


def _build_shape(kind: str, mesh: str) -> ET.Element:
    shape = ET.Element(kind, name=mesh)
    ET.SubElement(shape, "origin", xyz="0 0 0", rpy="0 0 0")
    ET.SubElement(ET.SubElement(shape, "geometry"), "mesh", filename=f"{MESHES}/{mesh}.obj")
    return shape


def is_box(hull: TriangleMesh) -> bool:
    """Whether a hull is the box around it."""
    low, high = aabb(hull.vertices)
    at_corner = np.minimum(np.abs(hull.vertices - low), np.abs(hull.vertices - high)).max(initial=0.0) < _FLAT_M
    return bool(len(hull.vertices) == 8 and at_corner)


def _build_box(name: str, hull: TriangleMesh) -> ET.Element:
    low, high = aabb(hull.vertices)
    shape = ET.Element("collision", name=name)
    ET.SubElement(shape, "origin", xyz=_format_numbers((low + high) / 2), rpy="0 0 0")
    ET.SubElement(ET.SubElement(shape, "geometry"), "box", size=_format_numbers(high - low))
    return shape


def _build_joint(content: ModelObject, kind: str) -> ET.Element:
    joint = ET.Element("joint", name=f"{WORLD}_to_{_name_link(content)}", type=kind)
    angles = _format_numbers(compute_roll_pitch_yaw(content.pose))
    ET.SubElement(joint, "origin", xyz=_format_numbers(content.pose.position), rpy=angles)
    ET.SubElement(joint, "parent", link=WORLD)
    ET.SubElement(joint, "child", link=_name_link(content))
    return joint


def compute_roll_pitch_yaw(pose: Pose) -> tuple[float, float, float]:
    """Compute URDF's angles [rad]: R = Rz(yaw) Ry(pitch) Rx(roll); roll is 0 at the poles."""
    R: Matrix3 = rotation_matrix(pose.quaternion_wxyz)
    level = float(np.hypot(R[0, 0], R[1, 0]))
    pitch = float(np.arctan2(-R[2, 0], level))
    if level < 1e-9:
        return 0.0, pitch, float(np.arctan2(-R[0, 1], R[1, 1]))
    return float(np.arctan2(R[2, 1], R[2, 2])), pitch, float(np.arctan2(R[1, 0], R[0, 0]))


def _format_numbers(values: Sequence[float] | np.ndarray) -> str:
    return " ".join(f"{float(value):.12g}" for value in values)


def encode_obj_files(look: VisualMesh, stem: str) -> dict[str, bytes]:
    """Encode `stem.obj`, `stem.mtl` and, for a textured mesh, `stem.png`."""
    texture = look.mesh.texture
    material = f"newmtl {stem}\nKs 0.05 0.05 0.05\nNs 20\nKd "
    head = f"mtllib {stem}.mtl\nusemtl {stem}\n".encode()
    if texture is None:
        material += " ".join(f"{channel / 255:.4f}" for channel in look.color) + "\n"
        return {f"{stem}.obj": head + encode_obj(look.mesh), f"{stem}.mtl": material.encode()}
    picture = encode_png(np.asarray(texture.picture))
    appearance = Appearance.at_corners(picture, np.asarray(texture.corner_uv))
    return {
        f"{stem}.obj": head + encode_obj(look.mesh, appearance),
        f"{stem}.mtl": f"{material}1 1 1\nmap_Kd {stem}.png\n".encode(),
        f"{stem}.png": picture,
    }


def _serialize(root: ET.Element) -> bytes:
    ET.indent(root)
    data: bytes = ET.tostring(root, encoding="utf-8", xml_declaration=True)
    return data + b"\n"
