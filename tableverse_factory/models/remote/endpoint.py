"""Address, limits and prices of a remote model."""

import os
from dataclasses import dataclass
from typing import Literal

from schemas.config import CurateConfig, RemoteModelSection
from schemas.outcome import ModelCost
from tableverse_factory.core.errors import ModelAccessError
from tableverse_factory.models.remote.exchange import Usage

Dialect = Literal["openai", "gemini", "grasps", "meshes"]
GEMINI_URL = "https://generativelanguage.googleapis.com/v1beta"
ATTEMPTS = 5
MOST_CALLS = 2 * ATTEMPTS  # maximum number of requests for one question: two rounds, each with all its retries
MAX_BODY_BYTES = 4 * 1024 * 1024


@dataclass(frozen=True, slots=True)
class Endpoint:
    """One model behind one address, without its key.

    Attributes:
        base_url: Address without `/chat/completions` or `/models/…`; checked by `schemas.address`.
        key_env: Environment variable that holds the key; empty for a server without keys.
        enforce_schema: Whether the server is asked to enforce the schema; some servers refuse to.
        timeout_s: Limit for a question with all retries, waits and the repair round [s].
        read_s: Longest silence of the server; models that think first are silent for long [s].
        attempts: Maximum number of requests per exchange.
        backoff_s: Wait before the first retry; it doubles with each further one [s].
        section: Section of the configuration that this comes from, for messages; empty without one.
    """

    dialect: Dialect
    base_url: str
    model: str
    key_env: str = ""
    enforce_schema: bool = True
    timeout_s: float = 240.0
    connect_s: float = 10.0
    read_s: float = 180.0
    max_body_bytes: int = MAX_BODY_BYTES
    attempts: int = ATTEMPTS
    backoff_s: float = 1.0
    usd_per_million_input: float = 0.0
    usd_per_million_output: float = 0.0
    section: str = ""

    def compute_cost(self, usage: Usage) -> ModelCost:
        """Compute the cost of a use by the prices."""
        price = usage.input_tokens * self.usd_per_million_input + usage.output_tokens * self.usd_per_million_output
        return ModelCost(usage.calls, usage.input_tokens, usage.output_tokens, price / 1e6)

    def read_key(self) -> str:
        """Read the key from the environment; empty if none is configured, ModelAccessError if it is no key."""
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


def read_endpoint(config: RemoteModelSection) -> Endpoint:
    """Read the endpoint of a section of the configuration; `gemini` without an address means Google's own."""
    return Endpoint(
        dialect="gemini" if config.protocol == "gemini" else "openai",
        base_url=config.base_url or GEMINI_URL,
        model=config.model,
        key_env=config.key_env,
        enforce_schema=config.enforce_schema,
        timeout_s=config.timeout_s,
        usd_per_million_input=config.usd_per_million_input,
        usd_per_million_output=config.usd_per_million_output,
        section="curate" if isinstance(config, CurateConfig) else "perceive",
    )
