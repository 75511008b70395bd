"""Modules that a library imports for plots of its own, imported only when it first uses them."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from types import ModuleType


class DeferredModule(ModuleType):
    """Module whose first attribute imports the true one in its place."""

    def __getattr__(self, name: str) -> object:
        if sys.modules.get(self.__name__) is self:
            del sys.modules[self.__name__]
        return getattr(import_module(self.__name__), name)


@contextmanager
def defer_modules(*names: str) -> Iterator[None]:
    """Defer modules that nobody has imported yet, for the libraries that the block imports.

    Not for use while other threads import.
    """
    deferred = {name: DeferredModule(name) for name in names if name not in sys.modules}
    for name, module in deferred.items():
        parent, _, child = name.rpartition(".")
        if parent in deferred:
            setattr(deferred[parent], child, module)
    sys.modules.update(deferred)
    try:
        yield
    finally:
        for name, module in deferred.items():
            if sys.modules.get(name) is module:
                del sys.modules[name]
