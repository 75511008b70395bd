"""Optional packages: imported where they are used, and missed with one line that says how to install them."""

import importlib
from types import ModuleType

from tableverse_factory.core.errors import InputError


def import_extra(module: str, what: str, extra: str) -> ModuleType:
    """Import a module of an optional package.

    Args:
        module: Dotted name.
        what: Feature that needs it, for the error: `the viewer`.
        extra: Extra of this project that installs it.

    Raises:
        InputError: `no_extra`, saying what to type, if it is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError:
        line = f"{what} needs {module.partition('.')[0]}: pip install 'tableverse-factory[{extra}]'"
        raise InputError(line, "no_extra") from None
