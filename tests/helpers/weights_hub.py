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
_TREE = re.compile(r"/api/models/(?P<name>[^/]+/[^/]+)/tree/(?P<revision>[^/]+)/(?P<path>.+)")
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
    """Its models, what goes wrong with it, and what it was asked for.

    Large files are named by sha256 and, with `cdn`, redirected to that address; small ones by git's hash.
    """

    models: dict[str, Model] = field(default_factory=dict)
    gated: set[str] = field(default_factory=set)
    asked: list[str] = field(default_factory=list)
    sent: list[tuple[str, str, str]] = field(default_factory=list)  # path, Range and Authorization of each GET
    silent_s: float = 0.0
    cdn: str = ""
    cuts: int = 0  # large bodies that break off in the middle
    pause_s: float = 0.0  # after each thousand bytes
    has_ranges: bool = True
    replaced: dict[str, bytes] = field(default_factory=dict)  # what is sent instead, by name
    status: int = 200  # of files
    says_size: bool = True


def name_file(path: str, data: bytes) -> str:
    """The hash by which the hub names a file."""
    if path.endswith(".safetensors"):
        return hashlib.sha256(data).hexdigest()
    return hashlib.sha1(b"blob %d\0%b" % (len(data), data), usedforsecurity=False).hexdigest()


class Handler(BaseHTTPRequestHandler):
    """One question."""

    hub: WeightsHub

    def do_GET(self) -> None:
        self.hub.asked.append(self.path)
        time.sleep(self.hub.silent_s)
        path = self.path.partition("?")[0]
        about, file, tree = _ASKED.fullmatch(path), _FILE.fullmatch(path), _TREE.fullmatch(path)
        found = about or file or tree
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
        elif tree:
            self.tell(404, {"X-Error-Code": "EntryNotFound"})  # no repository here has folders
        elif found["name"] in self.hub.gated:
            self.tell(403, {"X-Error-Code": "GatedRepo"})
        else:
            self.send_file(file["path"], model.commits[commit].get(file["path"]), commit)

    do_HEAD = do_GET  # noqa: N815 the name that http.server calls

    def send_file(self, path: str, data: bytes | None, commit: str) -> None:
        hub, at = self.hub, {"X-Repo-Commit": commit}
        if data is None:
            self.tell(404, {"X-Error-Code": "EntryNotFound", **at})
            return
        if hub.status != 200:
            self.tell(hub.status, {})
            return
        at["ETag"] = f'"{name_file(path, data)}"'
        if hub.cdn and path.endswith(".safetensors") and hub.cdn not in f"http://{self.headers['Host']}":
            linked = {"X-Linked-ETag": at["ETag"], "X-Linked-Size": str(len(data))}
            self.tell(302, {**at, **linked, "Location": f"{hub.cdn}{self.path}?Signature=secret"})
            return
        if self.command == "GET":
            hub.sent.append((path, self.headers.get("Range", ""), self.headers.get("Authorization", "")))
        body = hub.replaced.get(path, data) if self.command == "GET" else data
        start = 0
        if (asked := re.fullmatch(r"bytes=(\d+)-", self.headers.get("Range", ""))) and hub.has_ranges:
            start = int(asked[1])
            at["Content-Range"] = f"bytes {start}-{len(body) - 1}/{len(body)}"
        self.tell(206 if start else 200, at, body[start:])

    def tell(self, status, headers, body=b"") -> None:
        self.send_response(status)
        size = {"Content-Length": str(len(body))} if self.hub.says_size or self.command == "HEAD" else {}
        for key, value in {**size, **headers}.items():
            self.send_header(key, value)
        self.end_headers()
        if self.command == "HEAD":
            return
        if self.hub.cuts and len(body) > 10_000:
            self.hub.cuts -= 1
            body = body[: len(body) // 2]
        for first in range(0, len(body), 1000 if self.hub.pause_s else max(len(body), 1)):
            self.wfile.write(body[first : first + 1000] if self.hub.pause_s else body)
            time.sleep(self.hub.pause_s)

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
