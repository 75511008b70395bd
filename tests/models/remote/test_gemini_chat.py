"""Answers of Gemini as Google's client reads them, and what becomes of each of them."""

import asyncio
import base64

import pytest
from google.genai import types

from tableverse_factory.core.errors import AnswerInvalidError, ModelError
from tableverse_factory.models.remote.client import ModelClient
from tableverse_factory.models.remote.endpoint import Endpoint
from tableverse_factory.models.remote.exchange import ChatCompletion, Message
from tableverse_factory.models.remote.gemini_chat import complete_gemini
from tableverse_factory.models.remote.http import BoundedClient
from tableverse_factory.models.services import Services
from tests.helpers.model_server import Scripted, gemini

JPEG = b"\xff\xd8\xff" + bytes(range(256))
SCHEMA = {"type": "object", "properties": {}, "required": [], "additionalProperties": False}
COUNTS = {"promptTokenCount": 700, "candidatesTokenCount": 30, "thoughtsTokenCount": 12, "totalTokenCount": 742}
SPLIT = [{"text": "hm", "thought": True}, {"text": '{"a":'}, {"text": " 1}", "thoughtSignature": "c2ln"}]


@pytest.fixture
def read(server):
    """Reads one answer of the server."""

    def complete(body) -> ChatCompletion | None:
        server.say(Scripted(body))
        endpoint = Endpoint("gemini", server.url, "gemini-2.5-pro")

        async def ask() -> ChatCompletion | None:
            async with BoundedClient(endpoint, 5.0, {}) as client:
                return await complete_gemini(client, endpoint, (Message("user", "Look."),), None)

        return asyncio.run(ask())

    return complete


def test_a_round_of_repair_is_a_conversation_with_the_image_unchanged(server, tmp_path):
    server.say(gemini("no JSON"))
    client = ModelClient(Endpoint("gemini", server.url, "models/gemini-2.5-pro"), Services(tmp_path))
    with pytest.raises(AnswerInvalidError, match="no JSON object"):
        client.ask("Größe, 茶碗,\u2028 “cup”.", [JPEG], SCHEMA)
    assert server.paths == ["/v1/models/gemini-2.5-pro:generateContent"] * 2
    first, said, again = server.asked[-1]["contents"]
    image, text = first["parts"]
    assert base64.urlsafe_b64decode(image["inlineData"]["data"]) == JPEG
    assert text == {"text": "Größe, 茶碗,\u2028 “cup”."}
    assert (said["role"], said["parts"]) == ("model", [{"text": "no JSON"}])
    assert again["role"] == "user"


@pytest.mark.parametrize(
    ("body", "text", "tokens", "refusal", "cut_off"),
    [
        (gemini('{"a": 1}').body, '{"a": 1}', (700, 42), "", False),
        (gemini("", content={"role": "model", "parts": SPLIT}).body, '{"a": 1}', (700, 42), "", False),
        (gemini("", content={"parts": SPLIT[:1]}, finishReason="MAX_TOKENS").body, "", (700, 42), "", True),
        (
            {"candidates": [{"finishReason": "SAFETY"}], "usageMetadata": {"promptTokenCount": 700}},
            *("", (700, 0), "SAFETY", False),
        ),
        (gemini('{"a"', finishReason="RECITATION").body, '{"a"', (700, 42), "RECITATION", False),
        (
            {"promptFeedback": {"blockReason": "PROHIBITED_CONTENT"}, "usageMetadata": COUNTS},
            *("", (700, 42), "PROHIBITED_CONTENT", False),
        ),
        ({"candidates": [{"content": {"role": "model"}, "finishReason": "STOP"}]}, "", (0, 0), "", False),
        ({"candidates": [{"content": {"parts": [{"text": t}]}} for t in ("{}", "[]")]}, "{}", (0, 0), "", False),
    ],
)
def test_text_tokens_refusal_and_end_of_an_answer(read, body, text, tokens, refusal, cut_off):
    answer = read(body)
    assert answer.text == text
    assert (answer.usage.input_tokens, answer.usage.output_tokens) == tokens
    assert (answer.refusal, answer.cut_off) == (refusal, cut_off)


@pytest.mark.parametrize("body", [{"usageMetadata": []}, {}])
def test_an_answer_of_another_shape_is_no_completion(server, tmp_path, body):
    server.say(Scripted(body))
    with pytest.raises(ModelError, match="no completion"):
        ModelClient(Endpoint("gemini", server.url, "m"), Services(tmp_path)).ask("Look.", [], SCHEMA)
    assert len(server.asked) == 1


ENDS = {
    "answered": "FINISH_REASON_UNSPECIFIED STOP",
    "cut off": "MAX_TOKENS CONTINUATION",
    "refused": "SAFETY RECITATION LANGUAGE OTHER BLOCKLIST PROHIBITED_CONTENT SPII ESCALATION MODEL_ARMOR IMAGE_SAFETY "
    "IMAGE_PROHIBITED_CONTENT IMAGE_RECITATION",
    "asked again": "MALFORMED_FUNCTION_CALL UNEXPECTED_TOOL_CALL TOO_MANY_TOOL_CALLS MISSING_THOUGHT_SIGNATURE "
    "MALFORMED_RESPONSE NO_IMAGE IMAGE_OTHER PUP_LIMITED_DISABLED",
}
"""What becomes of an answer without text by its finish reason; a refused scene is dropped, a failed one asked again."""


@pytest.mark.parametrize("reason", [reason.value for reason in types.FinishReason])
def test_every_finish_reason_of_the_client_has_a_meaning(read, reason):
    (meaning,) = (name for name, reasons in ENDS.items() if reason in reasons.split())
    answer = read({"candidates": [{"finishReason": reason}]})
    assert answer.cut_off == (meaning == "cut off")
    assert answer.refusal == (reason if meaning == "refused" else "")
    assert answer.is_empty == (meaning in ("answered", "asked again"))


@pytest.mark.filterwarnings("default")
def test_a_finish_reason_that_the_client_does_not_know_is_no_refusal(read):
    assert (
        read({"candidates": [{"finishReason": "SOMETHING_NEW", "content": {"parts": [{"text": "{}"}]}}]}).text == "{}"
    )
