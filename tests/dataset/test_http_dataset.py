"""What a dataset says it was made with: read from wherever it lies, missing in other tools', never guessed."""

import json
from dataclasses import replace

import pytest

from tableverse_factory.cli.arm import check_robot_option
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.storage import http
from tableverse_factory.dataset.dataset import open_dataset
from tests.helpers.public_dataset import write_public_dataset
from tests.helpers.range_server import range_server


@pytest.fixture
def dataset(tmp_path):
    out = write_public_dataset(tmp_path / "out", n_bytes=10)
    run = json.loads((out / "run.json").read_text())
    run["config"] = {"trajectories": {"robot": "their/arm.xml"}}
    (out / "run.json").write_text(json.dumps(run))
    return out


def test_it_is_read_on_the_disk_and_over_http(dataset):
    with range_server(dataset) as server:
        for place in (str(dataset), server.address):
            assert open_dataset(place).record() == json.loads((dataset / "run.json").read_text())
            with pytest.raises(InputError, match="give that file with --robot"):
                check_robot_option(place, None, needed=True)


def test_none_is_another_tools_dataset(dataset):
    (dataset / "run.json").unlink()
    assert open_dataset(dataset).record() is None
    check_robot_option(str(dataset), None, needed=True)


@pytest.mark.parametrize("damaged", [b"", b"{", b"[]", b"\x00" * 100])
def test_a_damaged_one_is_not_taken_for_none(dataset, damaged, run):
    """Else the arm that somebody gives would not be held against the dataset's."""
    (dataset / "run.json").write_bytes(damaged)
    with pytest.raises(InputError) as caught:
        open_dataset(dataset).record()
    assert caught.value.reason == "bad_run"
    code, _, errors = run("report", dataset, "--dest", dataset.parent / "site")
    assert (code, errors.count("\n")) == (1, 2)
    assert "run.json" in errors
    assert not (dataset.parent / "site").exists()


@pytest.mark.heavy
def test_one_that_a_server_fails_to_give_is_not_taken_for_none(dataset, monkeypatch):
    monkeypatch.setattr(http, "RETRY_POLICY", replace(http.RETRY_POLICY, backoff_s=0.01))
    with range_server(dataset) as server:
        opened = open_dataset(server.address)
        server.fault = lambda handler, _: handler.answer(500, b"") or True
        with pytest.raises(InputError, match="the server answers 500"):
            opened.record()
