"""Names of datasets on the Hugging Face Hub, and its client."""

import re
from typing import TYPE_CHECKING

from tableverse_factory.core.errors import InputError
from tableverse_factory.core.optional_imports import import_extra
from tableverse_factory.core.storage.files import MAX_URI_CHARS
from tableverse_factory.core.text import sanitize_line

if TYPE_CHECKING:
    from huggingface_hub import HfApi

LIBRARY = "tableverse-factory"  # user agent of requests to the Hub

_PART = r"(?!.*(?:--|\.\.))[A-Za-z0-9](?:[A-Za-z0-9._-]{0,94}[A-Za-z0-9_])?"
_NAME = re.compile(rf"{_PART}/{_PART}")
_REVISION = re.compile(r"(?!.*\.\.)[A-Za-z0-9][A-Za-z0-9._/-]{0,199}")


def check_hub_name(name: str) -> str:
    """Return the name if it is an `OWNER/NAME`."""
    if not _NAME.fullmatch(name) or name.endswith(".git"):
        raise InputError(f"{sanitize_line(name, 100)!r} is no name of a dataset on the Hub: give OWNER/NAME")
    return name


def parse_hub_address(text: str) -> tuple[str, str]:
    """Parse `hf://datasets/OWNER/NAME`, with `@REVISION` for another than `main`; return name and revision."""
    rest = text.removeprefix("hf://datasets/").rstrip("/")
    name, at, revision = rest.partition("@")
    if len(text) > MAX_URI_CHARS or not text.startswith("hf://datasets/") or not _NAME.fullmatch(name):
        raise InputError(f"{sanitize_line(text, 200)}: give hf://datasets/OWNER/NAME, or …@REVISION")
    if at and not _REVISION.fullmatch(revision):
        raise InputError(f"{sanitize_line(text, 200)}: after @ stands a branch, a tag or a commit")
    return name, revision or "main"


def make_hub_api() -> "HfApi":
    """Make a client of the Hub at `HF_ENDPOINT`, with the token of `HF_TOKEN` or of `hf auth login`, if any."""
    hub = import_extra("huggingface_hub", "the Hugging Face Hub", "hub")
    return hub.HfApi(library_name=LIBRARY)
