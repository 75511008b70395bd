"""Asking a model for JSON: from the cache, else over the network, with one round of repair."""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar

from tableverse_factory.core.errors import AnswerInvalidError, ModelError
from tableverse_factory.models.remote.answers import AnswerCache, answer_key
from tableverse_factory.models.remote.chat import Chat
from tableverse_factory.models.remote.endpoint import ATTEMPTS, Endpoint
from tableverse_factory.models.remote.exchange import ChatCompletion, ChatProtocol, Message, Usage, whole_text
from tableverse_factory.models.remote.gemini import Gemini
from tableverse_factory.models.remote.http import post_json
from tableverse_factory.models.remote.http_errors import without_keys
from tableverse_factory.models.remote.json_text import json_object
from tableverse_factory.models.remote.rate_limiter import RateLimiter
from tableverse_factory.models.services import Services

LANGUAGES: dict[str, ChatProtocol] = {"openai": Chat(), "gemini": Gemini()}

MOST_CALLS = 2 * ATTEMPTS
"""Requests that one question may take: two rounds, with all that is sent again."""

_SHOWN_CHARS = 20_000
"""Of an answer that is sent back to be repaired."""

_KEY_CHARS = 8
"""A shorter key is a local server's for want of one, such as `none`, and may well be a word of an answer."""

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Reply(Generic[T]):
    """An answer that could be read.

    Attributes:
        value: As it was read.
        text: The model's own words.
        usage: Of every round, as the server counted when it answered.
        rounds: 1, or 2 where the first answer had to be repaired.
    """

    value: T
    text: str
    usage: Usage
    rounds: int


class ModelClient:
    """Asks one model, at the pace and within the budget of the services, whose meter counts what it costs.

    Answers are kept in the cache folder, so the same question is paid for once.
    """

    def __init__(self, endpoint: Endpoint, services: Services) -> None:
        self._endpoint = endpoint
        self._language = LANGUAGES[endpoint.dialect]
        self._cache = AnswerCache(services.cache_dir)
        self._pace = RateLimiter(services.cache_dir, services.asking)
        self._meter = services.meter

    def ask(self, prompt: str, images: Sequence[bytes], schema: Mapping[str, Any]) -> dict[str, Any]:
        """The JSON object that the model gives; it may ignore the schema, so check what is in it.

        Raises:
            ModelAccessError: if a person must act: key, permission, credit, proxy, a full disk.
            AnswerInvalidError: if there is no object in the answer, also after a round of repair, or a refusal.
            BudgetSpentError: if nothing more may be spent.
            ModelError: if the server does not answer, or no turn to ask comes in time.
        """
        return self.ask_for(json_object, prompt, images, schema).value

    def ask_for(
        self, read: Callable[[str], T], prompt: str, images: Sequence[bytes], schema: Mapping[str, Any]
    ) -> Reply[T]:
        """What `read` makes of the model's answer.

        An answer that `read` refuses goes back once, with the reason.

        Args:
            read: Makes a value of the model's words, or raises AnswerInvalidError saying what is wrong.
            prompt: What is asked.
            images: PNG or JPEG files.
            schema: JSON schema of the answer. Without bounds and lengths: servers refuse large grammars.

        Raises:
            ModelAccessError, AnswerInvalidError, BudgetSpentError, ModelError: see `ask`.
        """
        deadline = time.monotonic() + self._endpoint.timeout_s
        asked = (Message("user", prompt, tuple(images)),)
        first = self._complete(asked, schema, deadline)
        try:
            return Reply(_read(read, first), first.text, first.usage, 1)
        except AnswerInvalidError as problem:
            if first.refusal:
                raise
            repair = (
                Message("model", first.text[:_SHOWN_CHARS] or "(nothing)"),
                Message("user", _repair_prompt(problem)),
            )
            second = self._complete((*asked, *repair), schema, deadline)
        return Reply(_read(read, second), second.text, first.usage + second.usage, 2)

    def _complete(self, turns: tuple[Message, ...], schema: Mapping[str, Any], deadline: float) -> ChatCompletion:
        key = answer_key(self._endpoint, turns, schema)
        kept = self._cache.get(key)
        if kept is not None:
            self._meter.remember(self._endpoint.cost(kept.usage))
            return kept
        self._cache.check()
        sent = schema if self._endpoint.enforce_schema else None
        request = self._language.request(self._endpoint.base_url, self._endpoint.model, turns, sent)
        headers = self._language.headers(self._endpoint.key())
        tokens = Usage(calls=0)
        calls = self._meter.paid.calls

        def lack_of(body: Mapping[str, Any]) -> str:
            """What the answer lacks; it is paid for all the same."""
            nonlocal tokens
            completion = self._language.read(body)
            if completion is None:
                return ""
            counted = replace(completion.usage, calls=0)
            tokens += counted
            self._meter.answered(self._endpoint.cost(counted))
            return completion.lack

        body = post_json(self._endpoint, request, headers, deadline, lack_of, self._turn)
        completion = self._language.read(body)
        if completion is None:
            raise ModelError(f"{self._endpoint.base_url}: the answer is no completion; is the address right?")
        completion = replace(
            completion,
            text=whole_text(without_keys(completion.text, headers, least_chars=_KEY_CHARS)),
            refusal=whole_text(without_keys(completion.refusal, headers, least_chars=_KEY_CHARS)),
            usage=replace(tokens, calls=self._meter.paid.calls - calls),
        )
        self._cache.put(key, completion)
        return completion

    @contextmanager
    def _turn(self, deadline: float) -> Iterator[None]:
        self._meter.check()  # nobody waits for a turn that may not be used
        with self._pace.turn(deadline):
            self._meter.ask()
            yield


def _read(read: Callable[[str], T], completion: ChatCompletion) -> T:
    if completion.refusal:
        raise AnswerInvalidError(f"the model refused to answer: {completion.refusal}", "answer_refused")
    try:
        return read(completion.text)
    except AnswerInvalidError as error:
        if completion.cut_off:
            raise AnswerInvalidError(f"the answer was cut off: {error}", error.reason) from error
        raise


def _repair_prompt(problem: AnswerInvalidError) -> str:
    return (
        f"That answer cannot be used: {str(problem)[:500]}. "
        "Give the whole answer again, corrected, as one JSON object in the schema, and nothing else."
    )
