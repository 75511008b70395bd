"""A mesh as an OBJ file with its material and picture beside it, as most readers expect it."""

import numpy as np

from tableverse_factory.core.png import png_bytes
from tableverse_factory.delivery.formats.model_contents import VisualMesh
from tableverse_factory.physics.mjcf.obj_assets import Appearance, obj_bytes


def obj_files(look: VisualMesh, stem: str) -> dict[str, bytes]:
    """`stem.obj`, `stem.mtl` and, where the mesh has a texture, `stem.png`.

    Args:
        look: In its own frame [m].
        stem: Name of the files; letters, digits and `_.-` only.
    """
    texture = look.mesh.texture
    material = [f"newmtl {stem}", "Ks 0.05 0.05 0.05", "Ns 20"]
    head = f"mtllib {stem}.mtl\nusemtl {stem}\n".encode()
    if texture is None:
        material.append("Kd " + " ".join(f"{channel / 255:.4f}" for channel in look.color))
        return {f"{stem}.obj": head + obj_bytes(look.mesh), f"{stem}.mtl": _lines(material)}
    picture = png_bytes(np.asarray(texture.picture))
    appearance = Appearance.at_corners(picture, np.asarray(texture.corner_uv))
    material += ["Kd 1 1 1", f"map_Kd {stem}.png"]
    return {
        f"{stem}.obj": head + obj_bytes(look.mesh, appearance),
        f"{stem}.mtl": _lines(material),
        f"{stem}.png": picture,
    }


def _lines(lines: list[str]) -> bytes:
    return ("\n".join(lines) + "\n").encode()
