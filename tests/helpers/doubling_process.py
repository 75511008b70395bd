"""A process that doubles arrays, for the tests of what shares one: it dies where it is asked 13 for the first time."""

import os
from pathlib import Path

from tableverse_factory.core.errors import ModelAccessError
from tableverse_factory.models.local.model_daemon import run_daemon


def make(spec):
    def made(_):
        if spec.get("refuses"):
            raise ModelAccessError("no weights for this one")
        if spec.get("too_large"):
            raise MemoryError
        return answer

    def answer(questions):
        mark = Path(spec["mark"])
        if any(int(array[0]) == 13 for (array,) in questions) and not mark.exists():
            mark.write_text("died")
            os.abort()
        return [(2 * array,) for (array,) in questions]

    return 4, made


if __name__ == "__main__":
    run_daemon(make)
