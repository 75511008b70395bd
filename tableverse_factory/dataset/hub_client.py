"""Requests to the Hugging Face Hub through huggingface_hub, with retries and a time limit."""

import itertools
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, TypeVar

from tableverse_factory.core.errors import StoreError
from tableverse_factory.core.retry import RetryPolicy
from tableverse_factory.core.timeouts import call_with_timeout
from tableverse_factory.dataset.hub_errors import get_retry_after, is_transient, translate_errors
from tableverse_factory.dataset.hub_names import LIBRARY

if TYPE_CHECKING:
    from huggingface_hub import HfApi

RETRY_POLICY = RetryPolicy(attempts=5, backoff_s=2.0, max_backoff_s=300.0, max_asked_s=300.0)
TIMEOUT_S = 300.0  # time limit of an answer; requests that send bytes add to it [s]

_NO_SUCH_ENDPOINT = (404, 405, 501)

T = TypeVar("T")


def call_hub(name: str, request: Callable[[], T], timeout_s: float = TIMEOUT_S) -> T:
    """Call huggingface_hub, and again while the Hub is busy; whatever `request` raises counts as the Hub's error.

    Raises:
        ChangedError: if the dataset changed since the commit that was to be followed.
    """
    late = StoreError(
        f"{name}: the Hub gives no answer within {timeout_s:.0f} s: run the same command again, and if that does not "
        "help with HF_HUB_DISABLE_XET=1, which sends another way"
    )
    with translate_errors(name):
        for attempt in itertools.count(1):
            try:
                return call_with_timeout(timeout_s, request, late)
            except Exception as error:
                wait_s = RETRY_POLICY.next_wait(attempt, get_retry_after(error)) if is_transient(error) else None
                if wait_s is None:
                    raise
                time.sleep(wait_s)
    raise AssertionError("the last attempt returns or raises")


@contextmanager
def select_transfer(api: "HfApi", name: str) -> Iterator[None]:
    """Let huggingface_hub send by Xet only if the Hub supports it; otherwise it would retry in silence for minutes."""
    from huggingface_hub import constants

    before = constants.HF_HUB_DISABLE_XET
    constants.HF_HUB_DISABLE_XET = before or not call_hub(name, lambda: _has_xet(api, name))
    try:
        yield
    finally:
        constants.HF_HUB_DISABLE_XET = before


def _has_xet(api: "HfApi", name: str) -> bool:
    from huggingface_hub.utils import build_hf_headers, get_session, hf_raise_for_status

    address = f"{api.endpoint}/api/datasets/{name}/xet-write-token/main"
    response = get_session().get(address, headers=build_hf_headers(library_name=LIBRARY))
    if response.status_code in _NO_SUCH_ENDPOINT:
        return False
    hf_raise_for_status(response)
    return bool(response.headers.get("X-Xet-Cas-Url"))
