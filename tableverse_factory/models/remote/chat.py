"""Chat completions as OpenAI defined them: also vLLM, SGLang, Ollama, llama.cpp, LM Studio, OpenRouter, Ark."""

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


class Chat:
    """Speaks `POST <base URL>/chat/completions`; images travel as data URLs.

    Neither temperature nor a limit of tokens is sent: newer models refuse the one, thinking models run dry on the
    other. The schema goes as `response_format`; servers that ignore it are found out by the checks of the answer.
    """

    def request(
        self, base_url: str, model: str, turns: tuple[Message, ...], schema: Mapping[str, Any] | None
    ) -> HttpRequest:
        """The request for a completion, in a JSON schema where one is given."""
        body: dict[str, Any] = {"model": model, "messages": [_message(turn) for turn in turns]}
        if schema is not None:
            wanted = {"name": "answer", "strict": True, "schema": schema}
            body["response_format"] = {"type": "json_schema", "json_schema": wanted}
        return HttpRequest(f"{base_url.rstrip('/')}/chat/completions", body)

    def headers(self, key: str) -> dict[str, str]:
        """The headers that carry the key."""
        return {"Authorization": f"Bearer {key}"} if key else {}

    def read(self, body: Mapping[str, Any]) -> ChatCompletion | None:
        """The first choice, without the words of one that ended in an error; None where there is none."""
        message = get_path(body, "choices", 0, "message")
        if not isinstance(message, Mapping):
            return None
        end = get_path(body, "choices", 0, "finish_reason")
        refusal = message.get("refusal") or ("content filter" if end == "content_filter" else "")
        usage = Usage(
            count(get_path(body, "usage", "prompt_tokens")), count(get_path(body, "usage", "completion_tokens"))
        )
        text = "" if end == "error" else _text(message.get("content"))
        return ChatCompletion(text, usage, str(refusal)[:1000], end == "length")


def _message(turn: Message) -> dict[str, Any]:
    if turn.role == "model":
        return {"role": "assistant", "content": turn.text}
    pictures = [{"type": "image_url", "image_url": {"url": _data_url(image)}} for image in turn.images]
    return {"role": "user", "content": [*pictures, {"type": "text", "text": turn.text}]}


def _data_url(image: bytes) -> str:
    return f"data:{media_type(image)};base64,{base64.b64encode(image).decode()}"


def _text(content: Any) -> str:
    """Content is text, or a list of parts of which some are text."""
    if isinstance(content, list):
        return "".join(part for part in (get_path(item, "text") for item in content) if isinstance(part, str))
    return content if isinstance(content, str) else ""
