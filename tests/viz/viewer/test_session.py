"""Several browsers at once, through real sockets: none stops another, whatever it does."""

import logging
import threading
import time

import pytest

from tableverse_factory.dataset.dataset import open_dataset
from tableverse_factory.viz.viewer.scene_cache import SceneCache
from tableverse_factory.viz.viewer.server import Viewer
from tableverse_factory.viz.viewer.session import Session
from tests.helpers.viewer_client import Looker, until
from tests.helpers.viewer_dataset import write_viewed_dataset

pytestmark = pytest.mark.filterwarnings("ignore:Queued a .* on a closed connection")


@pytest.fixture
def alone(viewer):
    assert until(lambda: not viewer.sessions())
    return viewer


def looker(viewer: Viewer) -> tuple[Looker, Session]:
    before = set(viewer.sessions())
    browser = Looker(viewer.url)
    assert until(lambda: browser.ready)
    (session,) = set(viewer.sessions()) - before
    return browser, session


def goes_on(session: Session) -> bool:
    then = session.simulated_s
    return until(lambda: session.simulated_s > then + 0.1, 30.0)


@pytest.mark.slow  # plays two motions
@pytest.mark.heavy
def test_another_task_may_be_chosen_while_one_plays(alone):
    browser, session = looker(alone)
    with browser:
        none, moving = browser.options("Task")[:2]
        for number in range(25):
            browser.set("Task", moving)
            assert until(lambda: session.duration_s > 0.0)
            browser.set("Motion", "Play")
            assert until(lambda: session.playing)
            time.sleep(0.002 * (number % 17))  # anywhere within a tick
            browser.set("Task", none)
            assert until(lambda: session.duration_s == 0.0 and not session.playing)
        assert browser.told == []
        browser.set("Physics", "Play", "Group")
        assert goes_on(session)


@pytest.mark.heavy
def test_who_waits_for_something_stops_nobody_else(alone):
    (first, busy), (second, other) = looker(alone), looker(alone)
    free = threading.Event()
    with first, second:
        for browser in (first, second):
            browser.set("Physics", "Play", "Group")
        assert goes_on(busy)
        assert goes_on(other)
        waits = threading.Thread(target=busy._lock.run, args=(free.wait,))
        waits.start()
        try:
            assert goes_on(other)
            for number in range(100):  # a slider that is dragged meanwhile
                first.set("Table no.", number % 35)
            second.set("Physics", "Reset", "Group")
            assert until(lambda: not other.playing, 30.0)
        finally:
            free.set()
            waits.join()
        assert goes_on(busy)


@pytest.mark.heavy
def test_a_mistake_costs_its_own_browser_alone(alone, caplog):
    (first, broken), (second, other) = looker(alone), looker(alone)
    with first, second, caplog.at_level(logging.ERROR):
        for browser in (first, second):
            browser.set("Physics", "Play", "Group")
        assert goes_on(other)
        first.set("Speed", float("nan"))
        assert until(lambda: first.told)
        assert "ValueError" in first.told[0]
        assert not broken.playing
        assert goes_on(other)
        assert second.told == []
        first.set("Speed", 1.0)
        first.set("Physics", "Play", "Group")
        assert goes_on(broken)
    assert "an action of the viewer failed" in caplog.text


@pytest.mark.heavy
def test_a_scene_that_takes_long_keeps_nobody_from_another(tmp_path, monkeypatch):
    dataset = open_dataset(write_viewed_dataset(tmp_path / "out"))
    read, free, asked = dataset.scene, threading.Event(), []

    def slow(scene_id):
        asked.append(scene_id)
        if scene_id == "a-1":
            free.wait(30.0)
        return read(scene_id)

    monkeypatch.setattr(dataset, "scene", slow)
    shelf, got = SceneCache(dataset), []
    waiting = [threading.Thread(target=lambda: got.append(shelf.open("a-1"))) for _ in range(3)]
    for thread in waiting:
        thread.start()
    try:
        assert until(lambda: asked)
        assert shelf.open("b-2").scene.scene_id == "b-2"
        assert got == []
    finally:
        free.set()
        for thread in waiting:
            thread.join()
    assert asked == ["a-1", "b-2"]  # three who wait for one scene read it once
    assert len(got) == 3
    assert len(set(map(id, got))) == 1


def test_a_page_of_elsewhere_is_turned_away_and_said(alone, caplog):
    with caplog.at_level(logging.WARNING), Looker(alone.url, origin="https://evil.example") as browser:
        assert browser.ended.wait(10.0)
        assert alone.sessions() == []
    assert caplog.text.count("refused a page of https://evil.example") == 1
    assert "--allow-origin https://evil.example" in caplog.text


def test_a_page_behind_a_proxy_is_let_in_when_it_is_named(alone):
    page = "https://lab.example"
    named = Viewer(alone._scenes, "a-1", "127.0.0.1", 0, allowed=[f"{page}/proxy/8080/"])
    try:
        with Looker(named.url, origin=page) as browser:
            assert until(lambda: browser.ready)
            html = " ".join(str(control.get("content")) for control in browser.controls.values())
            assert "?websocket=wss://lab.example/proxy/8080/?scene=a-1" in html
    finally:
        named.stop()


@pytest.mark.heavy
def test_no_browser_opens_the_public_tunnel_of_viser(alone, monkeypatch):
    opened = []
    monkeypatch.setattr("viser.ViserServer.request_share_url", lambda *_, **__: opened.append(1))
    browser, session = looker(alone)
    with browser:
        browser.send({"type": "ShareUrlRequest"})
        browser.set("Physics", "Play", "Group")  # handled after the request
        assert goes_on(session)
    assert opened == []
