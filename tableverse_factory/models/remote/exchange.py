"""What goes to a model and what comes back, whatever protocol is spoken in between."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from schemas.identity import content_hash


@dataclass(frozen=True, slots=True)
class Message:
    """Something said.

    Attributes:
        role: `user` or `model`.
        text: The words.
        images: PNG or JPEG files that go with them.
    """

    role: str
    text: str
    images: tuple[bytes, ...] = ()


@dataclass(frozen=True, slots=True)
class Usage:
    """Tokens as the server counted them, 0 where it did not say, and the requests that it took."""

    input_tokens: int = 0
    output_tokens: int = 0
    calls: int = 1

    def __add__(self, other: "Usage") -> "Usage":
        return Usage(
            self.input_tokens + other.input_tokens,
            self.output_tokens + other.output_tokens,
            self.calls + other.calls,
        )


@dataclass(frozen=True, slots=True)
class ChatCompletion:
    """What a model said.

    Attributes:
        text: Its words; untrusted.
        usage: What it cost.
        refusal: Why it did not answer, in the server's words; empty where it did.
        cut_off: Whether it ran out of room before it was done.
    """

    text: str
    usage: Usage
    refusal: str = ""
    cut_off: bool = False

    @property
    def lack(self) -> str:
        """What is wrong with it that may pass: no words and no reason for that; empty where nothing is."""
        is_answer = self.text.strip() or self.refusal or self.cut_off
        return "" if is_answer else "the model broke off or said nothing"


@dataclass(frozen=True, slots=True)
class HttpRequest:
    """An HTTP request, less the key.

    Attributes:
        url: Where it goes.
        body: What is posted as JSON.
    """

    url: str
    body: Mapping[str, Any]


class ChatProtocol(Protocol):
    """How a kind of server is asked and understood."""

    def request(
        self, base_url: str, model: str, turns: tuple[Message, ...], schema: Mapping[str, Any] | None
    ) -> HttpRequest:
        """The request for a completion, in a JSON schema where one is given."""
        ...

    def headers(self, key: str) -> dict[str, str]:
        """The headers that carry the key."""
        ...

    def read(self, body: Mapping[str, Any]) -> ChatCompletion | None:
        """The completion in an answer; None where the answer holds none."""
        ...


def media_type(image: bytes) -> str:
    """`image/png` or `image/jpeg`, by the first bytes.

    Raises:
        ValueError: if it is neither.
    """
    if image.startswith(b"\x89PNG\r\n\x1a\n"):
        return "image/png"
    if image.startswith(b"\xff\xd8\xff"):
        return "image/jpeg"
    raise ValueError(f"an image of {len(image)} bytes is neither PNG nor JPEG (sha256 {content_hash(image)[:12]})")


def get_path(value: Any, *path: str | int) -> Any:
    """What stands at a path of keys and positions in somebody else's JSON; None where the path leads nowhere."""
    for step in path:
        if isinstance(step, str) and isinstance(value, Mapping):
            value = value.get(step)
        elif isinstance(step, int) and isinstance(value, list) and step < len(value):
            value = value[step]
        else:
            return None
    return value


def count(value: Any) -> int:
    """A count of tokens in somebody else's JSON; 0 where it is none."""
    is_count = isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 2**53
    return value if is_count else 0


def whole_text(text: str) -> str:
    """The text with halves of surrogate pairs replaced: JSON may hold them, files may not."""
    return text.encode("utf-8", errors="replace").decode()
