"""OBJ file of a textured mesh with its material and picture."""

import numpy as np

from tableverse_factory.core.png import encode_png
from tableverse_factory.delivery.formats.model_contents import VisualMesh
from tableverse_factory.physics.mjcf.obj_assets import Appearance, encode_obj


def encode_obj_files(look: VisualMesh, stem: str) -> dict[str, bytes]:
    """Encode `stem.obj`, `stem.mtl` and, for a textured mesh, `stem.png`."""
    texture = look.mesh.texture
    material = [f"newmtl {stem}", "Ks 0.05 0.05 0.05", "Ns 20"]
    head = f"mtllib {stem}.mtl\nusemtl {stem}\n".encode()
    if texture is None:
        material.append("Kd " + " ".join(f"{channel / 255:.4f}" for channel in look.color))
        return {f"{stem}.obj": head + encode_obj(look.mesh), f"{stem}.mtl": _lines(material)}
    picture = encode_png(np.asarray(texture.picture))
    appearance = Appearance.at_corners(picture, np.asarray(texture.corner_uv))
    material += ["Kd 1 1 1", f"map_Kd {stem}.png"]
    return {
        f"{stem}.obj": head + encode_obj(look.mesh, appearance),
        f"{stem}.mtl": _lines(material),
        f"{stem}.png": picture,
    }


def _lines(lines: list[str]) -> bytes:
    return ("\n".join(lines) + "\n").encode()
