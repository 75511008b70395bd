"""Where a model answers, and what an exchange with it may cost in time."""

import os
from dataclasses import dataclass
from typing import Literal

from schemas.config import AskedSection, CurateConfig
from schemas.outcome import Spent
from tableverse_factory.core.errors import ModelAccessError
from tableverse_factory.models.remote.exchange import Usage
from tableverse_factory.models.remote.gemini import PUBLIC_URL

Dialect = Literal["openai", "gemini", "grasps"]
ATTEMPTS = 5


@dataclass(frozen=True, slots=True)
class Endpoint:
    """One model behind one address; the key itself is never part of it.

    Attributes:
        dialect: Which protocol is spoken.
        base_url: Up to and without `/chat/completions` or `/models/…`; checked by `schemas.address`.
        model: As the server names it.
        key_env: Name of the environment variable with the key; empty for a server that wants none.
        enforce_schema: Whether the schema goes along for the server to enforce; some servers refuse it.
        timeout_s: For a question with everything it takes: retries, waiting for the server, a repair round [s].
        connect_s: For a connection [s].
        read_s: Longest silence of the server; models that think first are silent for long [s].
        attempts: Requests per exchange before it is given up.
        backoff_s: Wait before the first retry; doubles with each further one [s].
        usd_per_million_input: Price of a million tokens that it reads [USD].
        usd_per_million_output: Price of a million tokens that it writes [USD].
        section: Of the configuration that says all this, for messages; empty where none does.
    """

    dialect: Dialect
    base_url: str
    model: str
    key_env: str = ""
    enforce_schema: bool = True
    timeout_s: float = 240.0
    connect_s: float = 10.0
    read_s: float = 180.0
    attempts: int = ATTEMPTS
    backoff_s: float = 1.0
    usd_per_million_input: float = 0.0
    usd_per_million_output: float = 0.0
    section: str = ""

    def cost(self, usage: Usage) -> Spent:
        """What a use of it costs, by its prices."""
        price = usage.input_tokens * self.usd_per_million_input + usage.output_tokens * self.usd_per_million_output
        return Spent(usage.calls, usage.input_tokens, usage.output_tokens, price / 1e6)

    def key(self) -> str:
        """The key, from the environment of this process; empty where none is wanted.

        Raises:
            ModelAccessError: if the variable is unset, or holds what no HTTP header can.
        """
        if not self.key_env:
            return ""
        key = os.environ.get(self.key_env, "").strip()
        if not key:
            raise ModelAccessError(
                f"{self.key_env} is not set where the stages run: it must hold the key for {self.base_url}"
            )
        if not (key.isascii() and key.isprintable()):
            raise ModelAccessError(f"{self.key_env} holds characters that no key has: was it pasted whole?")
        return key


def endpoint_of(config: AskedSection) -> Endpoint:
    """The model that a section of the configuration asks; Google's own address where `gemini` is given none."""
    return Endpoint(
        dialect="gemini" if config.asked == "gemini" else "openai",
        base_url=config.base_url or PUBLIC_URL,
        model=config.model,
        key_env=config.key_env,
        enforce_schema=config.enforce_schema,
        timeout_s=config.timeout_s,
        usd_per_million_input=config.usd_per_million_input,
        usd_per_million_output=config.usd_per_million_output,
        section="curate" if isinstance(config, CurateConfig) else "perceive",
    )
