"""A Hub on this machine, and a dataset that may go there."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import huggingface_hub.constants
import pytest

from tableverse_factory.core.storage import http
from tableverse_factory.dataset import hub_client
from tests.helpers.hub_server import TOKEN, HubServer, hub_server
from tests.helpers.public_dataset import write_public_dataset


@pytest.fixture
def hub(monkeypatch, tmp_path) -> Iterator[HubServer]:
    """Where huggingface_hub looks for the Hub, in this process."""
    with hub_server() as running:
        for name, value in (("ENDPOINT", running.endpoint), ("HF_HUB_DISABLE_XET", False)):
            monkeypatch.setattr(huggingface_hub.constants, name, value)
        monkeypatch.setattr(huggingface_hub.constants, "HF_TOKEN_PATH", str(tmp_path / "no-token"))
        monkeypatch.setenv("HF_TOKEN", TOKEN)
        monkeypatch.setattr(hub_client, "RETRY_POLICY", replace(hub_client.RETRY_POLICY, backoff_s=0.01))
        monkeypatch.setattr(http, "RETRY_POLICY", replace(http.RETRY_POLICY, backoff_s=0.01))
        yield running


@pytest.fixture
def dataset(tmp_path) -> Path:
    """Three shards of two scenes, and what builds, editors and other tools leave beside them."""
    out = write_public_dataset(tmp_path / "out", shards=3)
    for name in (
        ".stages/observe/x",
        ".work/lock",
        ".cache/huggingface/x",
        "notes.txt",
        "mjcf/shard-00009.tar.partial",
    ):
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).write_text("not of the dataset")
    return out
