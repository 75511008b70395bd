"""Asking a model, against a real server: what it is sent, what may go wrong on the way, and what is paid for."""

import base64
import gzip
import io
import sys
import time
from datetime import UTC, datetime, timedelta
from email.utils import format_datetime

import pytest
from PIL import Image

from schemas.config import CurateConfig, PerceiveConfig
from tableverse_factory.core.errors import AnswerInvalidError, ModelAccessError, ModelError
from tableverse_factory.models.remote.client import ModelClient
from tableverse_factory.models.remote.endpoint import MAX_BODY_BYTES, Endpoint, read_endpoint
from tableverse_factory.models.remote.json_text import MAX_ANSWER_CHARS, parse_json_object
from tableverse_factory.models.services import Services
from tests.helpers.model_server import Scripted, chat, gemini

KEY = "sk-very-secret-0123456789"
SCHEMA = {"type": "object", "properties": {"a": {"type": "integer"}}, "required": ["a"], "additionalProperties": False}
OK = chat('{"a": 1}')


def picture(kind: str = "PNG") -> bytes:
    data = io.BytesIO()
    Image.new("RGB", (8, 6), "red").save(data, kind)
    return data.getvalue()


@pytest.fixture(autouse=True)
def key(monkeypatch):
    monkeypatch.setenv("JUDGE_KEY", KEY)


@pytest.fixture
def client(server, tmp_path):
    def make(dialect="openai", **options):
        quick = {"timeout_s": 5.0, "read_s": 2.0, "backoff_s": 0.01, "key_env": "JUDGE_KEY", **options}
        return ModelClient(Endpoint(dialect, server.url, "some/model-1", **quick), Services(tmp_path))

    return make


@pytest.mark.heavy
def test_a_chat_server_gets_prompt_picture_schema_and_key(client, server):
    server.say(OK)
    png, jpeg = picture(), picture("JPEG")
    assert client().ask("Look at this.", [png, jpeg], SCHEMA) == {"a": 1}
    (asked,) = server.asked
    assert server.paths == ["/v1/chat/completions"]
    assert server.headers[0]["authorization"] == f"Bearer {KEY}"
    assert asked["model"] == "some/model-1"
    assert asked["response_format"]["json_schema"]["schema"] == SCHEMA
    *images, text = asked["messages"][0]["content"]
    assert text["text"] == "Look at this."
    urls = [image["image_url"]["url"] for image in images]
    assert [url.partition(",")[0] for url in urls] == ["data:image/png;base64", "data:image/jpeg;base64"]
    assert [base64.b64decode(url.partition(",")[2]) for url in urls] == [png, jpeg]


def test_gemini_gets_the_same_in_its_own_words(client, server):
    server.say(gemini('{"a": 2}'))
    reply = client("gemini").ask_for(str, "Look.", [picture()], SCHEMA)
    assert reply.text == '{"a": 2}'
    assert (reply.usage.input_tokens, reply.usage.output_tokens) == (700, 42)
    assert server.paths == ["/v1/models/some/model-1:generateContent"]
    assert server.headers[0]["x-goog-api-key"] == KEY
    assert KEY not in str(server.paths) + str(server.asked)
    (asked,) = server.asked
    image, text = asked["contents"][0]["parts"]
    assert image["inlineData"]["mime_type"] == "image/png"
    assert text == {"text": "Look."}
    assert asked["generationConfig"] == {"responseMimeType": "application/json", "responseJsonSchema": SCHEMA}


@pytest.mark.parametrize("dialect", ["openai", "gemini"])
def test_a_server_that_refuses_schemas_is_asked_without(client, server, dialect):
    server.say(OK if dialect == "openai" else gemini('{"a": 1}'))
    assert client(dialect, enforce_schema=False).ask("Look.", [], SCHEMA) == {"a": 1}
    assert "additionalProperties" not in str(server.asked)


def test_thoughts_are_not_the_answer(client, server):
    thought = {"text": '{"a": 7}', "thought": True}
    server.say(gemini("", content={"parts": [thought, {"text": '{"a": '}, {"text": "3}"}]}))
    assert client("gemini").ask("Look.", [], SCHEMA) == {"a": 3}
    server.say(chat('<think>{"a": 9} or {"a": 8}?</think>{"a": 4}'))
    assert client().ask("Look.", [], SCHEMA) == {"a": 4}


def test_the_same_question_is_paid_for_once_also_by_another_process(client, server):
    server.say(OK)
    first = client().ask_for(str, "Look.", [picture()], SCHEMA)
    server.say(Scripted(status=500))
    assert client().ask_for(str, "Look.", [picture()], SCHEMA) == first
    assert server.asked == []
    assert first.usage.input_tokens == 900


@pytest.mark.parametrize("change", ["prompt", "schema", "picture", "model", "damage"])
def test_another_question_is_another_answer(client, server, tmp_path, change):
    server.say(OK)
    client().ask("Look.", [picture()], SCHEMA)
    server.say(chat('{"a": 2}'))
    if change == "damage":
        for path in tmp_path.rglob("*.json"):
            path.write_bytes(path.read_bytes().replace(b"900", b"901"))
    asker = ModelClient(Endpoint("openai", server.url, "other"), Services(tmp_path)) if change == "model" else client()
    prompt = "Look!" if change == "prompt" else "Look."
    images = [picture("JPEG" if change == "picture" else "PNG")]
    schema = {"type": "object"} if change == "schema" else SCHEMA
    assert asker.ask(prompt, images, schema) == {"a": 2}


def test_a_resumed_build_needs_no_key_for_what_is_paid(client, server, monkeypatch):
    server.say(OK)
    client().ask("Look.", [], SCHEMA)
    monkeypatch.delenv("JUDGE_KEY")
    assert client().ask("Look.", [], SCHEMA) == {"a": 1}
    with pytest.raises(ModelAccessError, match="JUDGE_KEY is not set where the stages run"):
        client().ask("Something else.", [], SCHEMA)


@pytest.mark.heavy
@pytest.mark.parametrize("status", [408, 429, 500, 502, 503, 504, 529])
def test_what_may_pass_is_asked_again(client, server, status):
    server.say(Scripted({"error": {"message": "busy"}}, status), Scripted(b"<html>", status), OK)
    assert client().ask("Look.", [], SCHEMA) == {"a": 1}
    assert len(server.asked) == 3


@pytest.mark.parametrize(
    "broken",
    [
        Scripted(b'{"choices": [{"mess'),
        Scripted(b'{"choices": [{"mess', headers={"Content-Length": "500"}),
        Scripted(write=lambda handler: handler.connection.close()),
        Scripted(b""),
        Scripted(b"null"),
        Scripted(b"[" * 100_000),
        Scripted({"error": {"message": "upstream is down", "code": 502}}),
        Scripted({"error": "try later"}),
        Scripted({"error": {"code": [], "type": {}, "details": [{"reason": []}, {"retryDelay": "²s"}, 7]}}),
        Scripted({"error": [["?"]]}, 503, {"Retry-After": "²"}),
        Scripted({"object": "error", "message": "engine restarts", "code": 503}),
        Scripted(gzip.compress(b"0" * 10_000_000), headers={"Content-Encoding": "gzip"}),
    ],
)
def test_half_answers_and_errors_in_disguise_are_asked_again(client, server, broken):
    server.say(broken, OK)
    assert client().ask("Look.", [], SCHEMA) == {"a": 1}


@pytest.mark.heavy
def test_the_server_says_when_to_come_back(client, server):
    server.say(Scripted(status=429, headers={"Retry-After": "1"}), OK)
    started = time.monotonic()
    assert client(backoff_s=0.001).ask("Look.", [], SCHEMA) == {"a": 1}
    assert time.monotonic() - started >= 1.0


@pytest.mark.parametrize(
    "answer",
    [
        Scripted(status=429, headers={"Retry-After": "3600"}),
        Scripted(status=503, headers={"Retry-After": format_datetime(datetime.now(UTC) + timedelta(hours=2))}),
        Scripted({"error": {"details": [{"retryDelay": "3600s"}]}}, 429),
        Scripted(status=429, headers={"Retry-After": "9" * 400}),
    ],
)
def test_nobody_waits_longer_than_there_is_time(client, server, answer):
    server.say(answer, OK)
    started = time.monotonic()
    with pytest.raises(ModelError, match="asks to wait"):
        client().ask("Look.", [], SCHEMA)
    assert time.monotonic() - started < 1.0


@pytest.mark.parametrize("header", ["soon", "-5", "Thu, 99 Foo", "", "Mon, 01 Jan 2020 00:00:00 +99999999999999"])
def test_nonsense_about_waiting_is_ignored(client, server, header):
    server.say(Scripted(status=429, headers={"Retry-After": header}), OK)
    assert client().ask("Look.", [], SCHEMA) == {"a": 1}


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (Scripted({"error": {"message": f"Incorrect API key provided: {KEY}"}}, 401), "refuses the key in JUDGE_KEY"),
        (Scripted(KEY.encode(), 401), "refuses the key in JUDGE_KEY"),
        (Scripted(gzip.compress(b"{}"), 401, {"Content-Encoding": "gzip"}), "refuses the key in JUDGE_KEY"),
        (Scripted({"error": {"message": f"no credit for {KEY}"}}, 402), "credit .* is spent"),
        (Scripted({"error": {"message": "x", "code": "insufficient_quota"}}, 429), "credit .* is spent"),
        (
            Scripted({"error": {"message": "x", "code": 400, "details": [{"reason": "API_KEY_INVALID"}]}}, 400),
            "refuses",
        ),
        (Scripted([{"error": {"message": "x", "code": 400, "details": [{"reason": "API_KEY_INVALID"}]}}], 400), "refu"),
        (Scripted({"error": {"message": f"{KEY}: not in your region"}}, 403), "not in your region"),
        (Scripted({"error": {"message": "no credit", "code": 402}}), "credit .* is spent"),
        (Scripted({"error": {"message": f"nothing here for {KEY}"}}, 404), "knows no model 'some/model-1'"),
    ],
)
def test_without_access_nothing_is_asked_twice_and_the_key_stays_secret(client, server, answer, words):
    server.say(answer, OK)
    with pytest.raises(ModelAccessError, match=words) as caught:
        client().ask("Look.", [], SCHEMA)
    assert len(server.asked) == 1
    assert KEY not in str(caught.value)


def test_a_refused_question_names_the_key_of_its_section(server, tmp_path):
    server.say(Scripted({"error": {"message": "bad request"}}, 400))
    for config in (
        PerceiveConfig(detector="openai", base_url=server.url, model="m"),
        CurateConfig(judge="openai", base_url=server.url, model="m"),
    ):
        with pytest.raises(ModelError, match=rf"configure {read_endpoint(config).section}\.enforce_schema: false"):
            ModelClient(read_endpoint(config), Services(tmp_path)).ask("Look.", [], SCHEMA)
    assert read_endpoint(config).section == "curate"


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (Scripted({"error": {"message": f"unknown field for {KEY}\n\x1b[31m"}}, 400), "HTTP 400: unknown field"),
        (Scripted({"error": {"message": "Invalid schema for response_format"}}, 400), "enforce_schema: false"),
        (Scripted({"error": {"message": "bad request"}}, 400), "configure enforce_schema: false"),
        (Scripted(status=301, headers={"Location": "http://elsewhere.example/"}), "redirect"),
        (Scripted(status=307, headers={"Location": "/v2"}), "redirect"),
        (Scripted({"hello": "world"}), "no completion"),
        (Scripted({"choices": "none"}), "no completion"),
    ],
)
def test_what_no_second_request_can_mend_ends_at_once(client, server, answer, words):
    server.say(answer, OK)
    with pytest.raises(ModelError, match=words) as caught:
        client().ask("Look.", [], SCHEMA)
    assert len(server.asked) == 1
    assert KEY not in str(caught.value)
    assert str(caught.value).isprintable()


def test_a_flood_is_not_read_to_its_end(client, server):
    sent = []

    def flood(handler):
        handler.send_response(200)
        handler.end_headers()
        for _ in range(1600):
            handler.wfile.write(b"x" * 65536)
            sent.append(65536)

    server.say(Scripted(write=flood))
    with pytest.raises(ModelError, match=f"longer than {MAX_BODY_BYTES}"):
        client().ask("Look.", [], SCHEMA)
    assert sum(sent) < 50_000_000


@pytest.mark.heavy
def test_an_answer_that_drips_ends_with_the_time_for_it(client, server):
    def drip(handler):
        handler.send_response(200)
        handler.end_headers()
        for _ in range(100):
            handler.wfile.write(b" ")
            time.sleep(0.05)

    server.say(Scripted(write=drip))
    started = time.monotonic()
    with pytest.raises(ModelError, match="no whole answer"):
        client(timeout_s=0.6).ask("Look.", [], SCHEMA)
    assert time.monotonic() - started < 2.0


@pytest.mark.heavy
def test_a_silent_server_and_one_that_is_not_there(client, server, tmp_path):
    server.say(Scripted(write=lambda handler: time.sleep(1.0)))
    with pytest.raises(ModelError, match="no answer in time"):
        client(read_s=0.2, attempts=2).ask("Look.", [], SCHEMA)
    nobody = Endpoint("openai", "http://127.0.0.1:9/v1", "m", timeout_s=2.0, attempts=2, backoff_s=0.01)
    with pytest.raises(ModelError, match="connection failed"):
        ModelClient(nobody, Services(tmp_path)).ask("Look.", [], SCHEMA)


def test_an_answer_without_json_goes_back_once_with_the_reason(client, server):
    server.say(chat("I see a mug."), chat('```json\n{"a": 5}\n```'))
    reply = client().ask_for(str.upper, "Look.", [picture()], SCHEMA)
    assert reply.rounds == 1  # str.upper takes anything
    assert client().ask("Look.", [picture()], SCHEMA) == {"a": 5}
    first, said, again = server.asked[-1]["messages"]
    assert first["role"] == "user"
    assert said == {"role": "assistant", "content": "I see a mug."}
    assert "no JSON object" in again["content"][0]["text"]


def test_two_answers_without_json_are_none_and_both_were_paid_for_once(client, server):
    server.say(chat("I see a mug."), chat("It is red."))
    for _ in range(2):
        with pytest.raises(AnswerInvalidError, match="no JSON object"):
            client().ask("Look.", [], SCHEMA)
    assert len(server.asked) == 2


def test_refusals_are_not_argued_with(client, server):
    server.say(chat("", finish_reason="content_filter"))
    with pytest.raises(AnswerInvalidError, match="refused") as caught:
        client().ask("Look.", [], SCHEMA)
    assert caught.value.reason == "answer_refused"
    server.say(Scripted({"promptFeedback": {"blockReason": "SAFETY"}}))
    with pytest.raises(AnswerInvalidError, match="SAFETY"):
        client("gemini").ask("Look.", [], SCHEMA)
    assert len(server.asked) == 1


@pytest.mark.parametrize(
    "error",
    [
        {
            "code": 403,
            "message": f"Your chosen model requires moderation and your input was flagged. {KEY}",
            "metadata": {"reasons": ["violence"], "provider_name": "somebody"},
        },
        {"code": 403, "message": "no", "metadata": {"reasons": ["sexual"]}},
        {"code": "content_policy_violation", "message": "This prompt may not be answered."},
        {"code": "InputImageSensitiveContentDetected", "message": "The image may show people."},
    ],
)
@pytest.mark.parametrize("status", [200, 400, 403])
def test_a_picture_that_is_refused_is_no_refused_key(client, server, error, status):
    server.say(Scripted({"error": error}, status), OK)
    with pytest.raises(AnswerInvalidError, match="refused the question") as caught:
        client().ask("Look.", [], SCHEMA)
    assert caught.value.reason == "answer_refused"
    assert len(server.asked) == 1
    assert KEY not in str(caught.value)


@pytest.mark.parametrize("message", ["The account was flagged.", "This key may not use this model.", ""])
def test_a_refused_permission_is_not_taken_for_a_refused_picture(client, server, message):
    server.say(Scripted({"error": {"message": message, "code": "permission_denied"}}, 403))
    with pytest.raises(ModelAccessError, match="may not use"):
        client().ask("Look.", [], SCHEMA)


BROKEN_OFF = (
    chat("", finish_reason="error"),
    chat('{"a": 7}', finish_reason="error"),
    chat("", message={"content": None}, finish_reason="stop"),
    chat(" \n"),
    gemini(""),
    gemini("", content={}),
    gemini("", content={"parts": [{"text": "hm", "thought": True}]}),
)


@pytest.mark.heavy
@pytest.mark.parametrize("broken", BROKEN_OFF)
def test_an_answer_without_words_is_asked_again(client, server, broken):
    dialect = "openai" if "choices" in broken.body else "gemini"
    server.say(broken, OK if dialect == "openai" else gemini('{"a": 1}'))
    reply = client(dialect).ask_for(parse_json_object, "Look.", [], SCHEMA)
    assert reply.value == {"a": 1}
    assert reply.rounds == 1
    assert len(server.asked) == 2


@pytest.mark.heavy
@pytest.mark.parametrize("broken", BROKEN_OFF)
def test_an_answer_without_words_is_not_kept(client, server, broken):
    dialect = "openai" if "choices" in broken.body else "gemini"
    server.say(broken)
    with pytest.raises(ModelError, match=r"said nothing \(asked 2 times"):
        client(dialect, attempts=2).ask("Look.", [], SCHEMA)
    server.say(OK if dialect == "openai" else gemini('{"a": 1}'))
    assert client(dialect).ask("Look.", [], SCHEMA) == {"a": 1}


def test_a_cut_answer_is_called_so(client, server):
    server.say(chat('{"a": ', finish_reason="length"))
    with pytest.raises(AnswerInvalidError, match="cut off"):
        client().ask("Look.", [], SCHEMA)


def test_no_room_for_answers_is_said_before_anything_is_paid(server, tmp_path):
    server.say(OK)
    (tmp_path / "answers").write_text("a file where the folder should be")
    with pytest.raises(ModelAccessError, match="cannot be kept"):
        ModelClient(Endpoint("openai", server.url, "m"), Services(tmp_path)).ask("Look.", [], SCHEMA)
    assert server.asked == []


def test_what_is_no_picture_is_not_sent(client, server):
    server.say(OK)
    with pytest.raises(ValueError, match="neither PNG nor JPEG"):
        client().ask("Look.", [b"GIF89a"], SCHEMA)


@pytest.mark.parametrize("before", range(100, 200, 7))
def test_a_connection_error_never_quotes_half_a_key(client, server, before):
    def echo(handler):
        handler.wfile.write(b"x" * before + KEY.encode() + b"\r\n\r\n")
        handler.close_connection = True

    server.say(Scripted(write=echo))
    with pytest.raises(ModelError, match="connection failed") as caught:
        client(attempts=1).ask("Look.", [], SCHEMA)
    assert KEY[:6] not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("ALL_PROXY", "socks5://someone:hidden@127.0.0.1:9"),
        ("HTTPS_PROXY", "carrier-pigeon://someone:hidden@127.0.0.1:9"),
        ("HTTPS_PROXY", "http://someone:hidden@127.0.0.1:high"),
        ("SSL_CERT_FILE", "/nowhere/hidden.pem"),
    ],
)
def test_a_proxy_of_no_use_stops_and_names_the_variables(tmp_path, monkeypatch, name, value):
    monkeypatch.setenv(name, value)
    asker = ModelClient(
        Endpoint("openai", "https://model.example/v1", "m", timeout_s=2.0, attempts=1), Services(tmp_path)
    )
    with pytest.raises(ModelAccessError, match=name) as caught:
        asker.ask("Look.", [], SCHEMA)
    assert "hidden" not in str(caught.value)


@pytest.mark.heavy
@pytest.mark.parametrize("dialect", ["openai", "gemini"])
def test_nothing_in_the_environment_changes_where_and_with_which_key_is_asked(client, server, monkeypatch, dialect):
    for name in ("OPENAI_API_KEY", "OPENAI_ORG_ID", "OPENAI_PROJECT_ID", "GOOGLE_API_KEY", "GEMINI_API_KEY"):
        monkeypatch.setenv(name, "from-the-environment")
    for name in ("OPENAI_BASE_URL", "GOOGLE_GEMINI_BASE_URL", "HTTP_PROXY", "ALL_PROXY"):
        monkeypatch.setenv(name, "http://127.0.0.1:9")
    for name in ("GOOGLE_GENAI_USE_VERTEXAI", "GOOGLE_GENAI_USE_ENTERPRISE"):
        monkeypatch.setenv(name, "true")
    monkeypatch.setenv("GOOGLE_API_USE_MTLS_ENDPOINT", "always")
    server.say(OK if dialect == "openai" else gemini('{"a": 1}'))
    assert client(dialect).ask("Look.", [], SCHEMA) == {"a": 1}
    assert "from-the-environment" not in str(server.headers)
    assert KEY in str(server.headers)
    assert client(dialect, key_env="").ask("Look again.", [], SCHEMA) == {"a": 1}
    assert not {"authorization", "x-goog-api-key"} & set(server.headers[-1])


@pytest.mark.parametrize(("dialect", "package"), [("openai", "openai"), ("gemini", "google.genai")])
def test_a_missing_package_is_named_with_the_extra_that_brings_it(client, server, monkeypatch, dialect, package):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ModelAccessError, match=r"pip install 'tableverse-factory\[vlm\]'"):
        client(dialect).ask("Look.", [], SCHEMA)
    assert server.asked == []


@pytest.mark.parametrize(
    "text",
    [
        "`" * MAX_ANSWER_CHARS,
        "```" + "a" * (MAX_ANSWER_CHARS - 3),
        "```" + "\n" * (MAX_ANSWER_CHARS - 3),
        "``` " * (MAX_ANSWER_CHARS // 4),
        "<think>" * (MAX_ANSWER_CHARS // 7),
        " " * MAX_ANSWER_CHARS,
        "`" * 1_000_000,
    ],
)
def test_a_flood_of_fences_is_read_in_no_time(text):
    started = time.process_time()
    with pytest.raises(AnswerInvalidError):
        parse_json_object(text)
    assert time.process_time() - started < 0.5


@pytest.mark.parametrize(
    "text",
    [
        '{"a": 1}',
        '{"a": "```"}',
        'As `{}` goes:\n```json\n{"a": 1}\n```\nand {more}',
        '<think>```{"a": 9}```</think>\n```\n{"a": 1}```',
        'Here: {"a": 1} ```',
        '```json\n{"a": 1}',
    ],
)
def test_the_object_is_found_wherever_a_model_puts_it(text):
    assert parse_json_object(text) in ({"a": 1}, {"a": "```"})
