"""Client for chat models that answer in JSON: cached, rate limited, within a budget, with one round of repair."""

import time
from collections.abc import Awaitable, Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar

from tableverse_factory.core.errors import AnswerInvalidError, ModelError
from tableverse_factory.core.retry import TransientError
from tableverse_factory.models.remote.answers import AnswerCache, compute_answer_key
from tableverse_factory.models.remote.endpoint import Endpoint
from tableverse_factory.models.remote.exchange import ChatCompletion, Message, Usage, replace_lone_surrogates
from tableverse_factory.models.remote.gemini_chat import complete_gemini
from tableverse_factory.models.remote.http import BoundedClient, send_with_retries
from tableverse_factory.models.remote.http_errors import format_host, redact_keys
from tableverse_factory.models.remote.json_text import parse_json_object
from tableverse_factory.models.remote.openai_chat import complete_openai
from tableverse_factory.models.remote.rate_limiter import RateLimiter
from tableverse_factory.models.services import Services

Complete = Callable[
    [BoundedClient, Endpoint, tuple[Message, ...], Mapping[str, Any] | None], Awaitable[ChatCompletion | None]
]
PROTOCOLS: dict[str, Complete] = {"openai": complete_openai, "gemini": complete_gemini}
_KEY_HEADERS: dict[str, Callable[[str], dict[str, str]]] = {
    "openai": lambda key: {"Authorization": f"Bearer {key}"},
    "gemini": lambda key: {"x-goog-api-key": key},
}

_REPAIR_CHARS = 20_000  # maximum length of an answer that is sent back for repair
_REPAIR_PROMPT = (
    "That answer cannot be used: {}. Give the whole answer again, corrected, as one JSON object in the schema, "
    "and nothing else."
)
_KEY_CHARS = 8  # shorter keys are placeholders for a local server, such as `none`, and may occur in an answer

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Reply(Generic[T]):
    """The value read from an answer's text, and the cost of its rounds: one, or two if it had to be repaired."""

    value: T
    text: str
    usage: Usage
    rounds: int


class ModelClient:
    """Client for one model, within the rate limit and budget of the services, whose meter counts the cost.

    Answers are kept in the cache folder, so that the same question is paid for once.
    """

    def __init__(self, endpoint: Endpoint, services: Services) -> None:
        self._endpoint = endpoint
        self._cache = AnswerCache(services.cache_dir)
        self._rate_limiter = RateLimiter(services.cache_dir, services.asking)
        self._meter = services.meter

    def ask(self, prompt: str, images: Sequence[bytes], schema: Mapping[str, Any]) -> dict[str, Any]:
        """Ask for a JSON object; the model may ignore the schema, so validate the result.

        Raises:
            ModelAccessError: if a person must act: key, permission, credit, proxy, a full disk.
            AnswerInvalidError: if the answer holds no object, also after a round of repair, or is a refusal.
            BudgetSpentError: if nothing more may be spent.
            ModelError: if the server does not answer, or the rate limit leaves no room in time.
        """
        return self.ask_for(parse_json_object, prompt, images, schema).value

    def ask_for(
        self, read: Callable[[str], T], prompt: str, images: Sequence[bytes], schema: Mapping[str, Any]
    ) -> Reply[T]:
        """Ask, and parse the answer with `read`; an answer that it refuses goes back once, with the reason.

        `read` raises AnswerInvalidError with what is wrong; images are PNG or JPEG files; the JSON schema has no bounds
        and lengths, as servers refuse large grammars. Other errors are those of `ask`.
        """
        deadline = time.monotonic() + self._endpoint.timeout_s
        question = (Message("user", prompt, tuple(images)),)
        first = self._complete(question, schema, deadline)
        try:
            return Reply(_parse_answer(read, first), first.text, first.usage, 1)
        except AnswerInvalidError as problem:
            if first.refusal:
                raise
            given = Message("model", first.text[:_REPAIR_CHARS] or "(nothing)")
            repair = Message("user", _REPAIR_PROMPT.format(str(problem)[:500]))
            second = self._complete((*question, given, repair), schema, deadline)
        return Reply(_parse_answer(read, second), second.text, first.usage + second.usage, 2)

    def _complete(self, messages: tuple[Message, ...], schema: Mapping[str, Any], deadline: float) -> ChatCompletion:
        key = compute_answer_key(self._endpoint, messages, schema)
        cached = self._cache.get(key)
        if cached is not None:
            self._meter.add_cached(self._endpoint.compute_cost(cached.usage))
            return cached
        self._cache.check()
        sent = schema if self._endpoint.enforce_schema else None
        headers = _KEY_HEADERS[self._endpoint.dialect](api_key) if (api_key := self._endpoint.read_key()) else {}
        tokens = Usage(calls=0)
        calls = self._meter.paid.calls

        async def send(client: BoundedClient) -> ChatCompletion:
            nonlocal tokens  # they are paid even if the completion is empty
            completion = await PROTOCOLS[self._endpoint.dialect](client, self._endpoint, messages, sent)
            if completion is None:
                host = format_host(self._endpoint.base_url)
                raise ModelError(f"{host}: the answer is no completion; is the address right?")
            used = replace(completion.usage, calls=0)
            tokens += used
            self._meter.add_tokens(self._endpoint.compute_cost(used))
            if completion.is_empty:
                raise TransientError("the model broke off or said nothing")
            return completion

        completion = send_with_retries(self._endpoint, send, headers, deadline, self._turn, key.encode())
        text, refusal = (
            replace_lone_surrogates(redact_keys(part, headers, min_chars=_KEY_CHARS))
            for part in (completion.text, completion.refusal)
        )
        usage = replace(tokens, calls=self._meter.paid.calls - calls)
        completion = replace(completion, text=text, refusal=refusal, usage=usage)
        self._cache.put(key, completion)
        return completion

    @contextmanager
    def _turn(self, deadline: float) -> Iterator[None]:
        self._meter.check()  # before waiting for a turn that may not be used
        with self._rate_limiter.turn(deadline):
            self._meter.add_request()
            yield


def _parse_answer(read: Callable[[str], T], completion: ChatCompletion) -> T:
    if completion.refusal:
        raise AnswerInvalidError(f"the model refused to answer: {completion.refusal}", "answer_refused")
    try:
        return read(completion.text)
    except AnswerInvalidError as error:
        if completion.cut_off:
            raise AnswerInvalidError(f"the answer was cut off: {error}", error.reason) from error
        raise
