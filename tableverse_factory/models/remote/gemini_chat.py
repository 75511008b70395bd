"""Chat completions through Google's `google-genai` client."""

from collections.abc import Mapping
from typing import Any

from pydantic import ValidationError

from tableverse_factory.models.remote.endpoint import Endpoint
from tableverse_factory.models.remote.exchange import (
    ChatCompletion,
    Message,
    Usage,
    check_count,
    detect_media_type,
    import_client,
)
from tableverse_factory.models.remote.http import BoundedClient

# Finish reasons of a candidate that is no answer.
_REFUSALS = (
    *("SAFETY", "RECITATION", "LANGUAGE", "BLOCKLIST", "PROHIBITED_CONTENT", "SPII", "ESCALATION", "MODEL_ARMOR"),
    *("IMAGE_SAFETY", "IMAGE_PROHIBITED_CONTENT", "IMAGE_RECITATION", "OTHER"),
)
_CUT_OFF = ("MAX_TOKENS", "CONTINUATION")


async def complete_gemini(
    client: BoundedClient, endpoint: Endpoint, messages: tuple[Message, ...], schema: Mapping[str, Any] | None
) -> ChatCompletion | None:
    """Request a completion, in a JSON schema where one is given; None if the answer holds none."""
    genai = import_client("google.genai")
    types = import_client("google.genai.types")
    contents = [
        types.Content(
            role=message.role,
            parts=[
                *(types.Part.from_bytes(data=i, mime_type=detect_media_type(i)) for i in message.images),
                types.Part.from_text(text=message.text),
            ],
        )
        for message in messages
    ]
    config = types.GenerateContentConfig(response_mime_type="application/json", response_json_schema=schema)
    # All of the environment's variables are overridden or refused by the HTTP client, which also adds the key.
    options = types.HttpOptions(base_url=endpoint.base_url, api_version="", httpx_async_client=client)
    api = genai.Client(api_key="unused", vertexai=False, http_options=options)
    try:
        answer = await api.aio.models.generate_content(model=endpoint.model, contents=contents, config=config)
    except ValidationError:
        return None
    finally:
        api.close()
    return _read_completion(answer)


def _read_completion(answer: Any) -> ChatCompletion | None:
    """Read the first candidate of a `GenerateContentResponse`, without its thoughts."""
    usage = Usage()
    if (tokens := answer.usage_metadata) is not None:
        written = check_count(tokens.candidates_token_count) + check_count(tokens.thoughts_token_count)
        usage = Usage(check_count(tokens.prompt_token_count), written)
    if answer.prompt_feedback is not None and answer.prompt_feedback.block_reason is not None:
        return ChatCompletion("", usage, answer.prompt_feedback.block_reason.value[:1000])
    if not answer.candidates:
        return None
    candidate = answer.candidates[0]
    end = candidate.finish_reason.value if candidate.finish_reason is not None else ""
    parts = (candidate.content.parts if candidate.content is not None else None) or []
    text = "".join(part.text for part in parts if part.text is not None and not part.thought)
    return ChatCompletion(text, usage, end if end in _REFUSALS else "", end in _CUT_OFF)
