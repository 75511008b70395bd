"""A hub of models on this machine, as huggingface_hub and transformers ask it: commits, branches and their files."""

import hashlib
import json
import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler

import huggingface_hub.constants

from tests.helpers.loopback import serving

_ASKED = re.compile(r"/api/models/(?P<name>[^/]+/[^/]+?)(/revision/(?P<revision>.+))?")
_FILE = re.compile(r"/(?P<name>[^/]+/[^/]+)/resolve/(?P<revision>[^/]+)/(?P<path>.+)")


@dataclass
class Model:
    """Files by commit, and which commit each branch and tag is at."""

    commits: dict[str, dict[str, bytes]] = field(default_factory=dict)
    refs: dict[str, str] = field(default_factory=dict)

    def commit(self, folder, branch="main") -> str:
        """What lies in a folder becomes the newest commit of a branch."""
        files = {path.name: path.read_bytes() for path in folder.iterdir()}
        said = repr((len(self.commits), sorted(files))).encode()
        oid = hashlib.sha1(said, usedforsecurity=False).hexdigest()
        self.commits[oid] = files
        self.refs[branch] = oid
        return oid


@dataclass
class WeightsHub:
    """Its models, those that only some may read, the paths that it was asked for, and how long it is silent [s]."""

    models: dict[str, Model] = field(default_factory=dict)
    gated: set[str] = field(default_factory=set)
    asked: list[str] = field(default_factory=list)
    silent_s: float = 0.0


class Handler(BaseHTTPRequestHandler):
    """One question."""

    hub: WeightsHub

    def do_GET(self) -> None:
        self.hub.asked.append(self.path)
        time.sleep(self.hub.silent_s)
        about, file = _ASKED.fullmatch(self.path), _FILE.fullmatch(self.path)
        found = about or file
        model = self.hub.models.get(found["name"]) if found else None
        if found is None or model is None:
            self.tell(401, {"X-Error-Code": "RepoNotFound"})
            return
        revision = found["revision"] or "main"
        commit = model.refs.get(revision, revision)
        if commit not in model.commits:
            self.tell(404, {"X-Error-Code": "RevisionNotFound"})
        elif about:
            self.tell(200, {}, json.dumps({"id": about["name"], "sha": commit, "siblings": [], "tags": []}).encode())
        elif found["name"] in self.hub.gated:
            self.tell(403, {"X-Error-Code": "GatedRepo"})
        else:
            data = model.commits[commit].get(file["path"])
            at = {"X-Repo-Commit": commit}
            if data is None:
                self.tell(404, {"X-Error-Code": "EntryNotFound", **at})
            else:
                self.tell(200, {"ETag": f'"{hashlib.sha256(data).hexdigest()}"', **at}, data)

    do_HEAD = do_GET  # noqa: N815 the name that http.server calls

    def tell(self, status, headers, body=b"") -> None:
        self.send_response(status)
        for key, value in {"Content-Length": str(len(body)), **headers}.items():
            self.send_header(key, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        pass


@contextmanager
def weights_hub(monkeypatch, cache) -> Iterator[WeightsHub]:
    """The hub for this process and those that it starts until the block ends, and a cache of its own."""
    hub = WeightsHub()
    with serving(type("Owned", (Handler,), {"hub": hub})) as address:
        for name, value in (("ENDPOINT", address), ("HF_HUB_CACHE", str(cache)), ("HF_HUB_DISABLE_XET", True)):
            monkeypatch.setattr(huggingface_hub.constants, name, value)
            monkeypatch.setenv(name if name.startswith("HF_") else f"HF_{name}", str(value))
        template = huggingface_hub.constants.HUGGINGFACE_CO_URL_TEMPLATE
        monkeypatch.setattr(
            huggingface_hub.constants,
            "HUGGINGFACE_CO_URL_TEMPLATE",
            address + "/" + template.partition("://")[2].partition("/")[2],
        )
        yield hub
