"""Chat completions through the `openai` client: also vLLM, SGLang, Ollama, llama.cpp, LM Studio, OpenRouter, Ark."""

import base64
from collections.abc import Mapping
from typing import Any

from tableverse_factory.models.remote.endpoint import Endpoint
from tableverse_factory.models.remote.exchange import (
    ChatCompletion,
    Message,
    Usage,
    check_count,
    detect_media_type,
    get_path,
    import_client,
)
from tableverse_factory.models.remote.http import BoundedClient


async def complete_openai(
    client: BoundedClient, endpoint: Endpoint, messages: tuple[Message, ...], schema: Mapping[str, Any] | None
) -> ChatCompletion | None:
    """Request a chat completion, in a JSON schema where one is given; None if the answer holds none.

    Neither temperature nor a limit of tokens is sent: newer models refuse the one, thinking models exhaust the other.
    Servers that ignore `response_format` are caught when the answer is validated.
    """
    openai = import_client("openai")
    options: dict[str, Any] = {}
    if schema is not None:
        wanted = {"name": "answer", "strict": True, "schema": schema}
        options["response_format"] = {"type": "json_schema", "json_schema": wanted}
    # All of the environment's variables are overridden or refused by the HTTP client, which also adds the key.
    api = openai.AsyncOpenAI(
        api_key="unused", base_url=endpoint.base_url, http_client=client, max_retries=0, timeout=client.timeout
    )
    answer = await api.chat.completions.create(
        model=endpoint.model, messages=[_to_openai(message) for message in messages], **options
    )
    return _read_completion(answer.model_dump(warnings=False))


def _to_openai(message: Message) -> dict[str, Any]:
    if message.role == "model":
        return {"role": "assistant", "content": message.text}
    images = [{"type": "image_url", "image_url": {"url": _encode_data_url(image)}} for image in message.images]
    return {"role": "user", "content": [*images, {"type": "text", "text": message.text}]}


def _encode_data_url(image: bytes) -> str:
    return f"data:{detect_media_type(image)};base64,{base64.b64encode(image).decode()}"


def _read_completion(body: Mapping[str, Any]) -> ChatCompletion | None:
    """Read the first choice of an untrusted answer; the `openai` client does not validate it.

    The text of a choice that ended in an error is dropped.
    """
    message = get_path(body, "choices", 0, "message")
    if not isinstance(message, Mapping):
        return None
    end = get_path(body, "choices", 0, "finish_reason")
    refusal = message.get("refusal") or ("content filter" if end == "content_filter" else "")
    usage = Usage(
        check_count(get_path(body, "usage", "prompt_tokens")), check_count(get_path(body, "usage", "completion_tokens"))
    )
    text = "" if end == "error" else _join_text(message.get("content"))
    return ChatCompletion(text, usage, str(refusal)[:1000], end == "length")


def _join_text(content: Any) -> str:
    if isinstance(content, list):
        return "".join(part for part in (get_path(item, "text") for item in content) if isinstance(part, str))
    return content if isinstance(content, str) else ""
