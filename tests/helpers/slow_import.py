"""A stage in a module that takes a second to import."""

import time

from tests.helpers.tiny_pipeline import look

__all__ = ["look"]

time.sleep(1.0)
