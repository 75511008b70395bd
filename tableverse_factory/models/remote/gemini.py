"""Gemini's generateContent over REST: the documented JSON, no client library."""

import base64
from collections.abc import Mapping
from typing import Any

from tableverse_factory.models.remote.exchange import (
    ChatCompletion,
    HttpRequest,
    Message,
    Usage,
    count,
    get_path,
    media_type,
)

PUBLIC_URL = "https://generativelanguage.googleapis.com/v1beta"
_REFUSALS = frozenset(
    {
        "SAFETY",
        "RECITATION",
        "LANGUAGE",
        "BLOCKLIST",
        "PROHIBITED_CONTENT",
        "SPII",
        "ESCALATION",
        "MODEL_ARMOR",
        "IMAGE_SAFETY",
        "IMAGE_PROHIBITED_CONTENT",
        "IMAGE_RECITATION",
        "OTHER",
    }
)
"""Ends of a candidate that are no answer."""

_CUT_OFF = ("MAX_TOKENS", "CONTINUATION")


class Gemini:
    """Speaks `POST <base URL>/models/<model>:generateContent`; images travel inline, the key in a header."""

    def request(
        self, base_url: str, model: str, turns: tuple[Message, ...], schema: Mapping[str, Any] | None
    ) -> HttpRequest:
        """The request for a completion, in a JSON schema where one is given."""
        name = model.removeprefix("models/")
        wanted: dict[str, Any] = {"responseMimeType": "application/json"}
        if schema is not None:
            wanted["responseJsonSchema"] = schema
        body = {"contents": [_content(turn) for turn in turns], "generationConfig": wanted}
        return HttpRequest(f"{base_url.rstrip('/')}/models/{name}:generateContent", body)

    def headers(self, key: str) -> dict[str, str]:
        """The headers that carry the key."""
        return {"x-goog-api-key": key} if key else {}

    def read(self, body: Mapping[str, Any]) -> ChatCompletion | None:
        """The first candidate, without its thoughts; None where there is none."""
        tokens = get_path(body, "usageMetadata")
        written = count(get_path(tokens, "candidatesTokenCount")) + count(get_path(tokens, "thoughtsTokenCount"))
        usage = Usage(count(get_path(tokens, "promptTokenCount")), written)
        blocked = get_path(body, "promptFeedback", "blockReason")
        if isinstance(blocked, str):
            return ChatCompletion("", usage, blocked[:1000])
        candidate = get_path(body, "candidates", 0)
        if not isinstance(candidate, Mapping):
            return None
        end = str(candidate.get("finishReason"))
        parts = get_path(candidate, "content", "parts")
        spoken = (part for part in (parts if isinstance(parts, list) else []) if get_path(part, "thought") is not True)
        text = "".join(part for part in (get_path(item, "text") for item in spoken) if isinstance(part, str))
        return ChatCompletion(text, usage, end if end in _REFUSALS else "", end in _CUT_OFF)


def _content(turn: Message) -> dict[str, Any]:
    pictures = [
        {"inlineData": {"mimeType": media_type(image), "data": base64.b64encode(image).decode()}}
        for image in turn.images
    ]
    return {"role": turn.role, "parts": [*pictures, {"text": turn.text}]}
