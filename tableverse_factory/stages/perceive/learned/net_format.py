"""Input and output of the learned segmenter's network, by which its file is checked before a build."""

from typing import Final

FORMAT: Final = "tableverse-segmenter-1"  # in the ONNX file's metadata; changes with the meaning of its input or output
CHANNELS: Final = 7
OUTPUTS: Final = 4  # logit of being an object, then the offset to its centre in the table frame in `OFFSET_UNIT_M`
THINNING: Final = 2  # rows and columns of the input per one of the output, whose pixel k is the input's pixel 2k
