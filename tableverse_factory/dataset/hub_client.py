"""Questions to the Hub through huggingface_hub: asked again while it is busy, and never waited for without end."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, TypeVar

from tableverse_factory.core.errors import StoreError
from tableverse_factory.core.timeouts import call_with_timeout
from tableverse_factory.dataset.hub_errors import is_transient, translate_errors, wait_asked_for
from tableverse_factory.dataset.hub_names import LIBRARY

if TYPE_CHECKING:
    from huggingface_hub import HfApi

ATTEMPTS = 5
TIMEOUT_S = 300.0
"""For an answer [s]; what sends bytes adds to it."""

_BACKOFF_S = 2.0
_LONGEST_WAIT_S = 300.0
_NO_SUCH_QUESTION = (404, 405, 501)

T = TypeVar("T")


def call_hub(name: str, question: Callable[[], T], patience_s: float | None = None) -> T:
    """What `question` gives, asked again where the Hub is busy.

    Args:
        name: Of the dataset, for what goes wrong.
        question: Calls huggingface_hub and nothing else: whatever it raises is taken for the Hub's fault.
        patience_s: How long one attempt may take [s].

    Raises:
        ChangedError: if the dataset changed since the commit that was to be followed.
        StoreError: if the Hub refuses, fails five times, or gives no answer in time.
    """
    wait, patience = _BACKOFF_S, TIMEOUT_S if patience_s is None else patience_s
    with translate_errors(name):
        for attempt in range(1, ATTEMPTS + 1):
            try:
                return call_with_timeout(patience, question, _late(name, patience))
            except Exception as error:
                asked = wait_asked_for(error)
                if attempt == ATTEMPTS or not is_transient(error) or (asked or 0.0) > _LONGEST_WAIT_S:
                    raise
                time.sleep(wait if asked is None else asked)
                wait = min(2 * wait, _LONGEST_WAIT_S)
    raise AssertionError("the last attempt returns or raises")


@contextmanager
def select_transfer(api: "HfApi", name: str) -> Iterator[None]:
    """Lets huggingface_hub send by Xet only where the Hub has it: one that has none is asked for minutes, in silence.

    Raises:
        StoreError: if the Hub refuses or does not answer.
    """
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
    if response.status_code in _NO_SUCH_QUESTION:
        return False
    hf_raise_for_status(response)
    return bool(response.headers.get("X-Xet-Cas-Url"))


def _late(name: str, seconds: float) -> StoreError:
    return StoreError(
        f"{name}: the Hub gives no answer within {seconds:.0f} s: run the same command again, and if that does not "
        "help with HF_HUB_DISABLE_XET=1, which sends another way"
    )
