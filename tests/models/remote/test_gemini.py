"""Our Gemini beside Google's own client: the same question in the same words, and the same answers read alike."""

import base64
import io
import re

import pytest
from google import genai
from google.genai import types
from PIL import Image

from tableverse_factory.models.remote.client import ModelClient
from tableverse_factory.models.remote.endpoint import Endpoint
from tableverse_factory.models.remote.exchange import Message
from tableverse_factory.models.remote.gemini import PUBLIC_URL, Gemini
from tableverse_factory.models.services import Services
from tableverse_factory.stages.perceive.vlm.schema import answer_schema
from tests.helpers.model_server import Scripted, gemini

KEY = "AIza-only-for-this-test"
MODEL = "gemini-2.5-pro"
PROMPT = "Name what stands on the table: Größe, 茶碗,\u2028 “cup”."
SCHEMA = answer_schema("yxyx")


def picture(kind):
    data = io.BytesIO()
    Image.effect_noise((40, 30), 90).convert("RGB").save(data, kind)
    return data.getvalue()


@pytest.fixture
def google(server, monkeypatch):
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    version = PUBLIC_URL.rpartition("/")[2]
    options = types.HttpOptions(base_url=server.url.removesuffix("/v1"), api_version=version)
    with genai.Client(api_key=KEY, http_options=options) as client:
        yield client


@pytest.fixture
def ours(server, monkeypatch, tmp_path):
    monkeypatch.setenv("GEMINI_KEY", KEY)
    address = server.url.removesuffix("v1") + PUBLIC_URL.rpartition("/")[2]
    return lambda **options: ModelClient(
        Endpoint("gemini", address, MODEL, "GEMINI_KEY", **options), Services(tmp_path)
    )


def asked_by_google(client, turns, schema):
    contents = []
    for turn in turns:
        kinds = ["image/png" if image.startswith(b"\x89PNG") else "image/jpeg" for image in turn.images]
        parts = [types.Part.from_bytes(data=image, mime_type=k) for image, k in zip(turn.images, kinds, strict=True)]
        contents.append(types.Content(role=turn.role, parts=[*parts, types.Part.from_text(text=turn.text)]))
    config = types.GenerateContentConfig(response_mime_type="application/json", response_json_schema=schema)
    return client.models.generate_content(model=MODEL, contents=contents, config=config)


def plain(value, key=""):
    """A body with names in camel case and bytes decoded, as the server takes either way; a JSON schema as it is."""
    if isinstance(value, dict) and key != "responseJsonSchema":
        names = {re.sub(r"_(.)", lambda found: found[1].upper(), name): item for name, item in value.items()}
        return {name: plain(item, name) for name, item in names.items()}
    if isinstance(value, list):
        return [plain(item) for item in value]
    return base64.b64decode(value.replace("-", "+").replace("_", "/")) if key == "data" else value


@pytest.mark.parametrize("schema", [SCHEMA, None], ids=["with a schema", "without"])
def test_the_same_question_arrives(server, google, ours, schema):
    server.say(gemini("{}"))
    images = (picture("PNG"), picture("JPEG"))
    ours(enforce_schema=schema is not None).ask_for(str, PROMPT, images, SCHEMA)
    asked_by_google(google, [Message("user", PROMPT, images)], schema)
    mine, googles = map(plain, server.asked)
    assert mine == googles
    assert [part["inlineData"]["data"] for part in mine["contents"][0]["parts"][:2]] == list(images)
    assert server.paths[0] == server.paths[1] == f"/v1beta/models/{MODEL}:generateContent"
    for name in ("content-type", "x-goog-api-key"):
        assert server.headers[0][name] == server.headers[1][name]
    assert server.headers[0]["x-goog-api-key"] == KEY


def test_a_round_of_repair_arrives_as_a_conversation(server, google, ours):
    turns = (Message("user", PROMPT, (picture("JPEG"),)), Message("model", "no JSON"), Message("user", "Give JSON."))
    server.say(gemini("{}"))
    asked_by_google(google, turns, SCHEMA)
    assert plain(dict(Gemini().request("http://unused", MODEL, turns, SCHEMA).body)) == plain(server.asked[0])


COUNTS = {"promptTokenCount": 700, "candidatesTokenCount": 30, "thoughtsTokenCount": 12, "totalTokenCount": 742}
SPLIT = [{"text": "hm", "thought": True}, {"text": '{"a":'}, {"text": " 1}", "thoughtSignature": "c2ln"}]
ANSWERS = {
    "text": gemini('{"a": 1}').body,
    "thoughts and parts": gemini("", content={"role": "model", "parts": SPLIT}).body,
    "thoughts alone": gemini("", content={"parts": SPLIT[:1]}, finishReason="MAX_TOKENS").body,
    "cut off": gemini('{"a": [1, 2', finishReason="MAX_TOKENS").body,
    "withheld": {"candidates": [{"finishReason": "SAFETY", "index": 0}], "usageMetadata": {"promptTokenCount": 700}},
    "half withheld": gemini('{"a"', finishReason="RECITATION").body,
    "blocked": {"promptFeedback": {"blockReason": "PROHIBITED_CONTENT"}, "usageMetadata": COUNTS},
    "no parts": {"candidates": [{"content": {"role": "model"}, "finishReason": "STOP"}], "usageMetadata": COUNTS},
    "no counts": {"candidates": [{"content": {"parts": [{"text": "{}"}]}, "finishReason": "STOP"}]},
    "two candidates": {"candidates": [{"content": {"parts": [{"text": t}]}} for t in ("{}", "[]")]},
}


@pytest.mark.parametrize("said", ANSWERS)
def test_the_same_answer_is_read_alike(server, google, said):
    server.say(Scripted(ANSWERS[said]))
    theirs = asked_by_google(google, [Message("user", PROMPT)], SCHEMA)
    mine = Gemini().read(ANSWERS[said])
    assert mine.text == (theirs.text or "")
    counted = theirs.usage_metadata or types.GenerateContentResponseUsageMetadata()
    assert mine.usage.input_tokens == (counted.prompt_token_count or 0)
    assert mine.usage.output_tokens == (counted.candidates_token_count or 0) + (counted.thoughts_token_count or 0)
    end = theirs.candidates[0].finish_reason if theirs.candidates else None
    assert mine.cut_off == (end is types.FinishReason.MAX_TOKENS)
    blocked = theirs.prompt_feedback.block_reason if theirs.prompt_feedback else None
    withheld = end if end in (types.FinishReason.SAFETY, types.FinishReason.RECITATION) else None
    assert mine.refusal == next((reason.value for reason in (blocked, withheld) if reason), "")


ENDS = {
    "answered": "FINISH_REASON_UNSPECIFIED STOP",
    "cut off": "MAX_TOKENS CONTINUATION",
    "refused": "SAFETY RECITATION LANGUAGE OTHER BLOCKLIST PROHIBITED_CONTENT SPII ESCALATION MODEL_ARMOR IMAGE_SAFETY "
    "IMAGE_PROHIBITED_CONTENT IMAGE_RECITATION",
    "asked again": "MALFORMED_FUNCTION_CALL UNEXPECTED_TOOL_CALL TOO_MANY_TOOL_CALLS MISSING_THOUGHT_SIGNATURE "
    "MALFORMED_RESPONSE NO_IMAGE IMAGE_OTHER PUP_LIMITED_DISABLED",
}
"""What becomes of an answer without text by why it ended; a dropped scene is not asked about again, a failed one is."""


@pytest.mark.parametrize("reason", [reason.value for reason in types.FinishReason])
def test_every_end_that_google_knows_has_a_meaning_here(reason):
    (meaning,) = (name for name, reasons in ENDS.items() if reason in reasons.split())
    mine = Gemini().read({"candidates": [{"finishReason": reason}]})
    assert mine.cut_off == (meaning == "cut off")
    assert mine.refusal == (reason if meaning == "refused" else "")
    assert bool(mine.lack) == (meaning in ("answered", "asked again"))
