"""What the dataset keeps of the picture: a JPEG, the instance ids and the camera."""

import io

import numpy as np
from PIL import Image

from schemas.objects import Evidence, PerceivedObject, PerceivedObjects
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.core.png import encode_png

MAX_MASK_VALUE = 65_535


def encode_evidence(scene: PerceivedObjects, objects: tuple[PerceivedObject, ...], jpeg_quality: int) -> Evidence:
    """The picture, and the masks of all that was found in it; `object_pixels` follows `objects`.

    Raises:
        GeometryError: if an instance id does not fit into 16 bits.
    """
    color = io.BytesIO()
    Image.fromarray(np.asarray(scene.observation.color)).save(color, "JPEG", quality=jpeg_quality)
    ids = np.maximum(scene.instance_ids, 0)
    if int(ids.max(initial=0)) > MAX_MASK_VALUE:
        raise GeometryError(f"instance id {int(ids.max())}: masks hold at most {MAX_MASK_VALUE}")
    return Evidence(
        color_jpg=color.getvalue(),
        masks_png=encode_png(ids.astype(np.uint16), compress_level=6),
        object_pixels=tuple(o.instance_id for o in objects),
        camera=scene.observation.camera,
        camera_to_table=scene.camera_to_table,
    )
