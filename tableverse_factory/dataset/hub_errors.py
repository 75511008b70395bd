"""Errors of the Hugging Face Hub as one line that says what to do and holds no token and no signed address."""

from collections.abc import Iterator
from contextlib import contextmanager

from tableverse_factory.core.errors import StoreError
from tableverse_factory.core.retry import parse_retry_after
from tableverse_factory.core.text import redact_secrets

_GO_ON = "What was done stays: run the same command again"

_CHANGED = 412
_PASSING = frozenset({409, 429, 500, 502, 503, 504})
_BY_STATUS = {
    401: "the Hub does not know the token: set HF_TOKEN, or log in with `hf auth login`",
    402: "the account's storage is used up",
    403: "the token may not do this: an upload needs write access to this owner (huggingface.co/settings/tokens)",
    404: "there is no such dataset, or the token may not see it",
    409: "another process is changing the dataset just now",
    _CHANGED: "another process changed the dataset",
    413: "the Hub finds a file or a commit too large",
    429: "the Hub asks to slow down",
}


class ChangedError(StoreError):
    """Error of a dataset on the Hub that changed since it was inspected."""


@contextmanager
def translate_errors(what: str) -> Iterator[None]:
    """Translate what huggingface_hub raises into one line."""
    from huggingface_hub.errors import HfHubHTTPError

    transport_error = HfHubHTTPError.__bases__[0]  # of the HTTP library that this release of huggingface_hub uses
    try:
        yield
    except StoreError:
        raise
    except (transport_error, OSError, ValueError, KeyError, RuntimeError) as error:
        inner = unwrap_error(error)
        if isinstance(inner, HfHubHTTPError):
            status, detail = inner.response.status_code, redact_secrets(inner.server_message or "")
            known = _BY_STATUS.get(status, f"the Hub answers {status}")
            kind = ChangedError if status == _CHANGED else StoreError
            raise kind(f"{what}: {known}{f' ({detail})' if detail else ''}. {_GO_ON}") from None
        why = f"{type(inner).__name__}: {redact_secrets(str(inner))}"
        raise StoreError(f"{what}: the Hub does not answer as it should ({why}). {_GO_ON}") from None


def unwrap_error(error: BaseException) -> BaseException:
    """Return the cause of a RuntimeError, which the library raises over an error of one of several files."""
    return error.__cause__ if isinstance(error, RuntimeError) and error.__cause__ is not None else error


def is_transient(error: BaseException) -> bool:
    """Return whether the Hub may answer the same request a little later."""
    from huggingface_hub.errors import HfHubHTTPError

    inner = unwrap_error(error)
    if isinstance(inner, HfHubHTTPError):
        return inner.response.status_code in _PASSING
    return isinstance(inner, HfHubHTTPError.__bases__[0])


def get_retry_after(error: BaseException) -> float | None:
    """Get the wait that the Hub asks for [s]; None if it asks for none."""
    response = getattr(unwrap_error(error), "response", None)
    return None if response is None else parse_retry_after(response.headers.get("retry-after"))
