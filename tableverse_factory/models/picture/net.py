"""The net of bare pictures: an ONNX file in this package, or one that a user trained, run on one CPU thread."""

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import Float32

from tableverse_factory.core.errors import ModelError, WeightsError
from tableverse_factory.models.local.onnx_session import open_onnx_session, shorten_onnx_error
from tableverse_factory.models.local.shipped_weights import read_shipped

SHIPPED = Path(__file__).with_name("picture.onnx")
DIGEST = SHIPPED.with_suffix(".sha256")
MULTIPLE: Final = 32  # height and width of the input are multiples of it
INPUTS: Final = {"image": 3, "rays": 3, "depth": 1}  # channels of (1, c, h, w)
MAPS: Final = {"label": 3, "log_depth": 1, "height": 1, "center": 1, "votes": 2, "boundary": 1, "affinity": 6}
REACHES: Final = (2, 8, 16)  # of affinities [px]
VECTORS: Final = {"plane": 4, "table": 1, "log_scale_sigma": 1}  # lengths of (1, n)
MAX_BYTES = 256 * 1024 * 1024

_Arrays = Mapping[str, Float32[np.ndarray, "..."]]


class PictureNet:
    """A session with the inputs `INPUTS` and the outputs `MAPS` and `VECTORS`, in the camera's frame.

    Inputs: `image` RGB in 0-1; `rays` the pixels' unit directions; `depth` of a sensor [m], 0 where there is none.

    Maps: `label` logits of neither, table and object; `log_depth` natural logarithm of the depth [m]; `height` over the
    table as a share of the depth; `center` logit of the middle of an object; `votes` from each pixel to the middle of
    its object, x and y [px]; `boundary` logit of an edge between objects; `affinity` logits that a pixel and the one
    `REACHES` px to its right, and then below it, are of one object.

    Vectors: `plane` the table's unit normal towards the camera, and its distance [m]; `table` logit of a table-top
    being shown; `log_scale_sigma` standard deviation of the logarithm of the scale.
    """

    def __init__(self, path: Path, data: bytes) -> None:
        self._name = path.name
        self._session = open_onnx_session(data, f"the net {str(path)!r}")
        inputs, outputs = (
            {one.name for one in ends} for ends in (self._session.get_inputs(), self._session.get_outputs())
        )
        if inputs != {*INPUTS} or not outputs >= {*MAPS, *VECTORS}:
            raise WeightsError(
                f"{str(path)!r} is another net: it takes {', '.join(sorted(inputs))} and gives "
                f"{', '.join(sorted(outputs))}; one of {', '.join(INPUTS)} to {', '.join([*MAPS, *VECTORS])} is wanted"
            )

    def __call__(self, inputs: _Arrays) -> dict[str, Float32[np.ndarray, "..."]]:
        """Run the net on maps of shape (c, h, w); the outputs come without their first axis.

        Raises:
            ModelError: if it cannot be run, or an output has another shape or is not finite.
        """
        names = [*MAPS, *VECTORS]
        try:
            found = self._session.run(names, {name: inputs[name][None] for name in INPUTS})
        except Exception as error:  # onnxruntime's errors have no common base
            raise ModelError(f"{self._name} cannot be run: {shorten_onnx_error(error)}") from error
        size = inputs["image"].shape[1:]
        shapes = {name: (1, count, *size) for name, count in MAPS.items()} | {n: (1, c) for n, c in VECTORS.items()}
        for name, array in zip(names, found, strict=True):
            if array.shape != shapes[name] or not np.isfinite(array).all():
                raise ModelError(f"{self._name} answers {name} of shape {array.shape}; finite {shapes[name]} is wanted")
        return {name: array[0].astype(np.float32) for name, array in zip(names, found, strict=True)}


@cache
def load_picture_net(weights: str = "") -> PictureNet:
    """Load the net in a file, or the one of this package, once per process.

    Raises:
        WeightsError: if the file is missing or damaged, or holds another net.
    """
    return _load(weights)


def check_picture_net(weights: str, key: str) -> None:
    """Check that a build can load the net that `key` of the configuration names; it is not kept.

    Raises:
        WeightsError: as `load_picture_net`.
    """
    try:
        _load(weights)
    except WeightsError as error:
        raise WeightsError(f"{key}: {error}") from error


def _load(weights: str) -> PictureNet:
    if not weights:
        return PictureNet(SHIPPED, read_shipped(SHIPPED, DIGEST))
    path = Path(weights)
    if not path.is_file():
        raise WeightsError(f"{weights!r} is no file here: give the .onnx file of a net")
    if path.stat().st_size > MAX_BYTES:
        raise WeightsError(f"{weights!r} has {path.stat().st_size} bytes, and a net at most {MAX_BYTES}")
    return PictureNet(path, path.read_bytes())
