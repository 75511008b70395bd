"""Axis conventions: which axis points up, and where a camera looks."""

import numpy as np

Y_UP_TO_Z_UP = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
"""Rotation from y up (glTF) to z up; its transpose goes back. Shape (3, 3)."""

OPENCV_TO_OPENGL = np.array([0.0, 1.0, 0.0, 0.0])
"""Half a turn about x, wxyz: from cameras that look along +z with y down to cameras that look along -z with y up."""
