"""A pipeline whose stage takes a second to import; that of `MISSING` is not there."""

from dataclasses import replace

from schemas.manifest import SceneKind
from tableverse_factory.stage import DeferredFunction
from tests.helpers.tiny_pipeline import PIPELINES as TINY

_LOOK = TINY[SceneKind.CAPTURE][0]
PIPELINES = {SceneKind.CAPTURE: (replace(_LOOK, run=DeferredFunction("tests.helpers.slow_import:look")),)}
MISSING = {SceneKind.CAPTURE: (replace(_LOOK, run=DeferredFunction("tests.helpers.no_such_module:look")),)}
