"""Methods to compare, from command-line arguments."""

from collections.abc import Sequence
from pathlib import Path

from tableverse_factory.core.errors import InputError

MAX_METHODS = 12


def parse_methods(paths: Sequence[Path], named: Sequence[str]) -> dict[str, Path]:
    """Parse methods by name: paths first, named after their last part, then `NAME=PATH`; raise `bad_method`."""
    methods: dict[str, Path] = {}
    entries = [(path.resolve().stem, path) for path in paths]
    for text in named:
        name, equals, path_text = text.partition("=")
        if not (name.strip() and equals and path_text):
            raise InputError(f"method {text!r:.100}: give NAME=PATH", "bad_method")
        entries.append((name.strip(), Path(path_text)))
    for name, path in entries:
        if name in methods:
            raise InputError(f"two methods are called {name!r:.100}: name them with --method NAME=PATH", "bad_method")
        methods[name] = path
    if not 1 <= len(methods) <= MAX_METHODS:
        raise InputError(
            f"{len(methods)} methods: give 1 to {MAX_METHODS}, as PATH or --method NAME=PATH", "bad_method"
        )
    return methods
