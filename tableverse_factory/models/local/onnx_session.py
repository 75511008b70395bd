"""Sessions of onnxruntime: one CPU thread, and nothing read but the bytes that were checked."""

import os
import re
from typing import Any

from tableverse_factory.core.errors import WeightsError

_CODE = re.compile(r"^\[ONNXRuntimeError\] : \d+ : \w+ : ")


def open_onnx_session(data: bytes, described: str) -> Any:
    """Open a session on the bytes of an ONNX file; `described` names the file in messages.

    Raises:
        WeightsError: if the bytes are no ONNX file that holds all of its weights.
    """
    import onnxruntime  # not at the head: builds without a net need neither its memory nor its time

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.enable_cpu_mem_arena = False  # it would keep the memory of the largest picture for good
    options.log_severity_level = 4
    # run.json has the hash of this file alone: it must not read weights from others
    options.add_session_config_entry("session.model_external_initializers_file_folder_path", os.devnull)
    try:
        return onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's errors have no common base
        raise WeightsError(f"{described} is no ONNX file: {shorten_onnx_error(error)}") from error


def shorten_onnx_error(error: Exception) -> str:
    """Return the start of a message of onnxruntime, in one line without its code and full stop."""
    return _CODE.sub("", " ".join(str(error).split()))[:200].rstrip(".")
