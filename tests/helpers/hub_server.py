"""A server on this machine that speaks what huggingface_hub speaks to the Hub: repositories, LFS, commits, files."""

import base64
import hashlib
import json
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler
from urllib.parse import parse_qs, unquote, urlsplit

import yaml

from tests.helpers.loopback import serving

TOKEN = "hf_onlyForThisTest"  # noqa: S105 - of no account
LARGE = (".parquet", ".tar")


@dataclass
class Repository:
    """A dataset on the Hub: a tree of files for every commit, the newest last."""

    private: bool
    commits: list[tuple[str, str, dict[str, bytes]]] = field(default_factory=list)

    @property
    def files(self) -> dict[str, bytes]:
        return self.commits[-1][2]

    @property
    def messages(self) -> list[str]:
        return [message for _, message, _ in self.commits[1:]]

    def commit(self, message: str, files: dict[str, bytes]) -> str:
        oid = hashlib.sha1(f"{len(self.commits)} {sorted(files)}".encode(), usedforsecurity=False).hexdigest()
        self.commits.append((oid, message, files))
        return oid

    def last_of(self, path: str) -> tuple[str, str]:
        """Commit and message that wrote a file as it is."""
        found = self.commits[-1]
        for before in reversed(self.commits[:-1]):
            if before[2].get(path) != found[2][path]:
                break
            found = before
        return found[:2]

    def at(self, revision: str) -> dict[str, bytes] | None:
        if revision == "main":
            return self.files
        return next((files for oid, _, files in self.commits if oid == revision), None)


@dataclass
class HubServer:
    """What is on the Hub, what was sent to it, and what it does wrong.

    Attributes:
        objects: Large files by their sha256.
        put: How often each of them was sent.
        sent: Bytes of bodies that it sent, by path of the address.
        asked: Questions by method and path.
        storage_of_xet: Where it sends whoever may write to; a Hub without Xet has none.
        tokens_seen: Signed addresses that somebody told the token.
        fault: Called with the handler, the method and the path before an answer; True where it has answered itself.
    """

    endpoint: str = ""
    repositories: dict[str, Repository] = field(default_factory=dict)
    objects: dict[str, bytes] = field(default_factory=dict)
    put: Counter[str] = field(default_factory=Counter)
    sent: Counter[str] = field(default_factory=Counter)
    asked: Counter[str] = field(default_factory=Counter)
    fault: Callable[["Handler", str, str], bool] | None = None
    storage_of_xet: str = ""
    tokens_seen: set[str] = field(default_factory=set)
    lock: threading.Lock = field(default_factory=threading.Lock)


class Handler(BaseHTTPRequestHandler):
    """One question."""

    protocol_version = "HTTP/1.1"
    hub: HubServer

    def do_GET(self) -> None:
        self.handle_all("GET")

    def do_POST(self) -> None:
        self.handle_all("POST")

    def do_PUT(self) -> None:
        self.handle_all("PUT")

    def handle_all(self, method: str) -> None:
        path = unquote(urlsplit(self.path).path)
        self.body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        self.hub.asked[f"{method} {path}"] += 1
        if self.hub.fault is not None and self.hub.fault(self, method, path):
            return
        if path.startswith(("/storage/", "/cdn/")):  # signed addresses: the token has no business there
            if self.headers.get("Authorization"):
                self.hub.tokens_seen.add(path)
            self.storage(method, path.rpartition("/")[2])
        elif self.headers.get("Authorization") != f"Bearer {TOKEN}":
            self.json(401, {"error": "Invalid credentials in Authorization header"})
        else:
            self.answer_api(method, path)

    def answer_api(self, method: str, path: str) -> None:
        parts = path.strip("/").split("/")
        if path == "/api/repos/create":
            self.create()
        elif path == "/api/validate-yaml":
            head = json.loads(self.body)["content"].split("---\n")[1]
            ok = "configs" in yaml.safe_load(head)
            self.json(200 if ok else 400, {"errors": [] if ok else [{"message": "no configs"}], "warnings": []})
        elif path.endswith(".git/info/lfs/objects/batch"):
            self.batch()
        elif path.startswith("/datasets/") and parts[3] == "resolve":
            self.resolve("/".join(parts[1:3]), parts[4], "/".join(parts[5:]))
        elif path.startswith("/api/datasets/"):
            self.repository(method, "/".join(parts[2:4]), parts[4:])
        else:
            self.json(404, {"error": f"{method} {path}"})

    def create(self) -> None:
        asked = json.loads(self.body)
        name = f"{asked['organization']}/{asked['name']}"
        if name in self.hub.repositories:
            self.json(409, {"error": "You already created this dataset repo", "url": f"{self.hub.endpoint}/{name}"})
            return
        made = self.hub.repositories[name] = Repository(asked.get("visibility") == "private")
        made.commit("initial commit", {".gitattributes": b"*.tar filter=lfs\n"})
        self.json(200, {"url": f"{self.hub.endpoint}/datasets/{name}", "name": name, "id": name})

    def repository(self, method: str, name: str, rest: list[str]) -> None:
        found = self.hub.repositories.get(name)
        if found is None:
            self.json(404, {"error": "Repository not found"}, {"X-Error-Code": "RepoNotFound"})
        elif not rest or rest[0] == "revision":
            files = found.at(rest[1] if rest else "main")
            if files is None:
                self.json(404, {"error": "Invalid rev id"}, {"X-Error-Code": "RevisionNotFound"})
                return
            oid = next(oid for oid, _, there in reversed(found.commits) if there is files)
            self.json(200, {"id": name, "sha": oid, "private": found.private, "siblings": [], "tags": []})
        elif rest[0] == "tree":
            self.tree(found.at(rest[1]) or {}, "/".join(rest[2:]))
        elif rest[0] == "preupload":
            self.preupload(found)
        elif rest[0] == "commit":
            with self.hub.lock:
                self.commit(name, found)
        elif rest[0] == "paths-info":
            self.paths_info(found, found.at(rest[1]) or {})
        elif rest[0] == "xet-write-token" and self.hub.storage_of_xet:
            told = {
                "X-Xet-Cas-Url": self.hub.storage_of_xet,
                "X-Xet-Access-Token": "x",
                "X-Xet-Token-Expiration": "9" * 10,
            }
            body = {"casUrl": self.hub.storage_of_xet, "accessToken": "x", "exp": 9999999999}
            self.json(200, body, told)
        else:
            self.json(404, {"error": "Cannot GET " + "/".join(rest)})

    def paths_info(self, found: Repository, files: dict[str, bytes]) -> None:
        entries = []
        for path in parse_qs(self.body.decode()).get("paths", []):
            oid, title = found.last_of(path)
            last = {"id": oid, "title": title, "date": "2026-01-01T00:00:00.000Z"}
            size, blob = len(files[path]), git_hash(files[path])
            entries.append({"type": "file", "path": path, "size": size, "oid": blob, "lastCommit": last})
        self.json(200, entries)

    def tree(self, files: dict[str, bytes], folder: str) -> None:
        prefix = f"{folder}/" if folder else ""
        inside = [path for path in files if path.startswith(prefix)]
        if folder and not inside:
            self.json(404, {"error": "Entry not found"}, {"X-Error-Code": "EntryNotFound"})
            return
        entries = {}
        for path in sorted(inside):
            first, below, _ = path[len(prefix) :].partition("/")
            kind = {"type": "directory", "size": 0} if below else {"type": "file", "size": len(files[path])}
            entries[prefix + first] = {**kind, "path": prefix + first, "oid": "0" * 40}
        self.json(200, list(entries.values()))

    def preupload(self, found: Repository) -> None:
        answers = []
        for asked in json.loads(self.body)["files"]:
            path = asked["path"]
            there = found.files.get(path)
            mode = "lfs" if path.endswith(LARGE) else "regular"
            oid = None if there is None else sha256(there) if mode == "lfs" else git_hash(there)
            answers.append({"path": path, "uploadMode": mode, "shouldIgnore": False, "oid": oid})
        self.json(200, {"files": answers})

    def batch(self) -> None:
        objects = []
        for asked in json.loads(self.body)["objects"]:
            answer = dict(asked)
            if asked["oid"] not in self.hub.objects:
                href = f"{self.hub.endpoint}/storage/{asked['oid']}?X-Amz-Signature=secret"
                answer["actions"] = {"upload": {"href": href}}
            objects.append(answer)
        self.json(200, {"transfer": "basic", "objects": objects})

    def storage(self, method: str, oid: str) -> None:
        if method == "PUT":
            if sha256(self.body) != oid:
                self.json(400, {"error": "another content"})
                return
            self.hub.objects[oid] = self.body
            self.hub.put[oid] += 1
            self.json(200, {})
        else:
            self.file(self.hub.objects[oid], oid)

    def commit(self, name: str, found: Repository) -> None:
        files, message = dict(found.files), ""
        for line in self.body.splitlines():
            said = json.loads(line)
            key, value = said["key"], said["value"]
            if key == "header":
                message = value["summary"]
                if value.get("parentCommit", found.commits[-1][0]) != found.commits[-1][0]:
                    self.json(412, {"error": "A commit has happened since. Please refresh and try again."})
                    return
            elif key == "file":
                files[value["path"]] = base64.b64decode(value["content"])
            elif key == "lfsFile":
                files[value["path"]] = self.hub.objects[value["oid"]]
            elif key == "deletedFile":
                del files[value["path"]]
            elif key == "deletedFolder":
                files = {path: data for path, data in files.items() if not path.startswith(value["path"])}
        oid = found.commit(message, files)
        self.json(200, {"commitUrl": f"{self.hub.endpoint}/datasets/{name}/commit/{oid}", "commitOid": oid})

    def resolve(self, name: str, revision: str, path: str) -> None:
        files = self.hub.repositories[name].at(revision) if name in self.hub.repositories else None
        if files is None or path not in files:
            self.json(404, {"error": "Entry not found"}, {"X-Error-Code": "EntryNotFound"})
        elif path.endswith(LARGE):
            elsewhere = self.hub.endpoint.replace("127.0.0.1", "localhost")
            self.json(302, {}, {"Location": f"{elsewhere}/cdn/{sha256(files[path])}?Signature=secret"})
        else:
            self.file(files[path], git_hash(files[path]))

    def file(self, data: bytes, tag: str) -> None:
        said = self.headers.get("Range")
        first, _, last = (said or f"bytes=0-{len(data) - 1}").removeprefix("bytes=").partition("-")
        start, stop = int(first), min(len(data), int(last) + 1)
        more = {"Content-Range": f"bytes {start}-{stop - 1}/{len(data)}"} if said else {}
        self.answer(206 if said else 200, data[start:stop], {"ETag": f'"{tag}"', **more})

    def json(self, status: int, value: object, headers: dict[str, str] | None = None) -> None:
        self.answer(status, json.dumps(value).encode(), {"Content-Type": "application/json", **(headers or {})})

    def answer(self, status: int, body: bytes, headers: dict[str, str]) -> None:
        self.send_response(status)
        for key, value in {"Content-Length": str(len(body)), **headers}.items():
            self.send_header(key, value)
        self.end_headers()
        self.hub.sent[unquote(urlsplit(self.path).path)] += len(body)
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        time.sleep(0)


def sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def git_hash(data: bytes) -> str:
    return hashlib.sha1(b"blob %d\0" % len(data) + data, usedforsecurity=False).hexdigest()


@contextmanager
def hub_server() -> Iterator[HubServer]:
    """A Hub until the block ends."""
    hub = HubServer()
    with serving(type("Owned", (Handler,), {"hub": hub})) as hub.endpoint:
        yield hub
