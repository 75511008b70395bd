"""Network of the detector `learned`: an ONNX file, run on one CPU thread."""

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from tableverse_factory.core.errors import ModelError, WeightsError
from tableverse_factory.models.local.onnx_session import open_onnx_session, shorten_onnx_error
from tableverse_factory.stages.perceive.learned.net_format import CHANNELS, FORMAT, OUTPUTS, THINNING

MAX_BYTES = 64 * 1024 * 1024
_KEY = "perceive.detector_weights"


class SegmentationNet:
    """A session of onnxruntime with one input and one output as `compute_features` describes them."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._session = _open_session(path)
        file_format = self._session.get_modelmeta().custom_metadata_map.get("format", "")
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        if file_format != FORMAT or len(inputs) != 1 or len(outputs) != 1 or inputs[0].shape[1:2] != [CHANNELS]:
            raise WeightsError(f"{_KEY} = {str(path)!r} is another net: give one of `tableverse train segmenter`")
        self._input = inputs[0].name

    def __call__(self, inputs: Float32[np.ndarray, "7 h w"]) -> Float32[np.ndarray, "4 h2 w2"]:
        """Run the network; another shape of output or one that is not finite is a `ModelError`."""
        try:
            output = self._session.run(None, {self._input: inputs[None]})[0]
        except Exception as error:  # onnxruntime's errors have no common base
            raise ModelError(f"{self._path.name} cannot be run: {shorten_onnx_error(error)}") from error
        wanted = (1, OUTPUTS, inputs.shape[1] // THINNING, inputs.shape[2] // THINNING)
        if output.shape != wanted or output.dtype != np.float32 or not np.isfinite(output).all():
            raise ModelError(f"{self._path.name} answers {output.dtype} of shape {output.shape}; {wanted} is wanted")
        return output[0]


@cache
def load_net(weights: str) -> SegmentationNet:
    """Load the network in this file, once per process."""
    return SegmentationNet(Path(weights))


def check_net(weights: str) -> None:
    """Check that a build can load the network in this file, else raise WeightsError; it is not kept."""
    SegmentationNet(Path(weights))


def _open_session(path: Path) -> Any:
    if not path.is_file():
        raise WeightsError(f"{_KEY} = {str(path)!r} is no file: give the .onnx of `tableverse train segmenter`")
    if path.stat().st_size > MAX_BYTES:
        raise WeightsError(f"{_KEY} = {str(path)!r} is larger than {MAX_BYTES} bytes: no net of ours")
    return open_onnx_session(path.read_bytes(), f"{_KEY} = {str(path)!r}")
