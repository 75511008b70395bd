"""Network of the detector `learned`: an ONNX file, run on one CPU thread."""

import os
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from tableverse_factory.core.errors import InputError, ModelAccessError, ModelError
from tableverse_factory.core.optional_imports import import_extra
from tableverse_factory.stages.perceive.learned.features import CHANNELS, FORMAT, OUTPUTS, THINNING

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
            raise ModelAccessError(f"{_KEY} = {str(path)!r} is another net: give one of `tableverse train segmenter`")
        self._input = inputs[0].name

    def __call__(self, inputs: Float32[np.ndarray, "7 h w"]) -> Float32[np.ndarray, "4 h2 w2"]:
        """Run the network; another shape of output or one that is not finite is a `ModelError`."""
        try:
            output = self._session.run(None, {self._input: inputs[None]})[0]
        except Exception as error:  # onnxruntime's errors have no common base
            raise ModelError(f"{self._path.name} cannot be run: {_shorten_error(error)}") from error
        wanted = (1, OUTPUTS, inputs.shape[1] // THINNING, inputs.shape[2] // THINNING)
        if output.shape != wanted or output.dtype != np.float32 or not np.isfinite(output).all():
            raise ModelError(f"{self._path.name} answers {output.dtype} of shape {output.shape}; {wanted} is wanted")
        return output[0]


@cache
def load_net(weights: str) -> SegmentationNet:
    """Load the network in this file, once per process."""
    return SegmentationNet(Path(weights))


def _open_session(path: Path) -> Any:
    try:
        runtime: Any = import_extra("onnxruntime", "the detector 'learned'", "models")
    except InputError as error:
        raise ModelAccessError(str(error)) from None
    if not path.is_file():
        raise ModelAccessError(f"{_KEY} = {str(path)!r} is no file: give the .onnx of `tableverse train segmenter`")
    if path.stat().st_size > MAX_BYTES:
        raise ModelAccessError(f"{_KEY} = {str(path)!r} is larger than {MAX_BYTES} bytes: no net of ours")
    options = runtime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    # run.json has the hash of this file alone: it must not read weights from others
    options.add_session_config_entry("session.model_external_initializers_file_folder_path", os.devnull)
    try:
        return runtime.InferenceSession(path.read_bytes(), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's errors have no common base
        raise ModelAccessError(f"{_KEY} = {str(path)!r} is no ONNX file: {_shorten_error(error)}") from error


def _shorten_error(error: Exception) -> str:
    return " ".join(str(error).split())[:200]
