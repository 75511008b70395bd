"""Messages to a chat model and its completions, independent of the protocol."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from schemas.identity import content_hash
from tableverse_factory.core.errors import InputError, ModelAccessError
from tableverse_factory.core.optional_imports import import_extra


@dataclass(frozen=True, slots=True)
class Message:
    """A message of `user` or `model`: PNG or JPEG files, then text."""

    role: str
    text: str
    images: tuple[bytes, ...] = ()


@dataclass(frozen=True, slots=True)
class Usage:
    """Tokens as counted by the server, 0 where unknown, and the number of requests."""

    input_tokens: int = 0
    output_tokens: int = 0
    calls: int = 1

    def __add__(self, other: "Usage") -> "Usage":
        return Usage(
            self.input_tokens + other.input_tokens, self.output_tokens + other.output_tokens, self.calls + other.calls
        )


@dataclass(frozen=True, slots=True)
class ChatCompletion:
    """Untrusted answer of a chat model, or its reason to refuse one; `cut_off` if it ended at a limit of tokens."""

    text: str
    usage: Usage
    refusal: str = ""
    cut_off: bool = False

    @property
    def is_empty(self) -> bool:
        """Whether there is neither text nor a reason for its absence, so that another attempt may help."""
        return not (self.text.strip() or self.refusal or self.cut_off)


def detect_media_type(image: bytes) -> str:
    """Return `image/png` or `image/jpeg`, by the first bytes; ValueError if it is neither."""
    if image.startswith(b"\x89PNG\r\n\x1a\n"):
        return "image/png"
    if image.startswith(b"\xff\xd8\xff"):
        return "image/jpeg"
    raise ValueError(f"an image of {len(image)} bytes is neither PNG nor JPEG (sha256 {content_hash(image)[:12]})")


def get_path(value: Any, *path: str | int) -> Any:
    """Return the value at a path of keys and positions in untrusted JSON, or None if there is none."""
    for step in path:
        if isinstance(step, str) and isinstance(value, Mapping):
            value = value.get(step)
        elif isinstance(step, int) and isinstance(value, list) and step < len(value):
            value = value[step]
        else:
            return None
    return value


def check_count(value: Any) -> int:
    """Return an untrusted count of tokens, or 0 if it is no such count."""
    is_count = isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 2**53
    return value if is_count else 0


def replace_lone_surrogates(text: str) -> str:
    """Replace halves of surrogate pairs, which JSON may hold and files may not."""
    return text.encode("utf-8", errors="replace").decode()


def import_client(module: str) -> Any:
    """Import the package of a protocol; ModelAccessError if it is not installed."""
    try:
        return import_extra(module, "a model behind an address", "vlm")
    except InputError as error:
        raise ModelAccessError(str(error)) from None
