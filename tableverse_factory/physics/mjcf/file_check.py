"""Check of the files that an untrusted MJCF document reads, before MuJoCo opens any: one folder, bounded size.

MuJoCo follows every path that a document names, devices and pipes included. The base folder of a path depends on
settings that may be in another document, so each path is tried in all possible folders. MuJoCo removes `..` from the
text of a path before it opens it, so each is tried with and without: all files that MuJoCo opens are checked here.
"""

import mmap
import os
import re
import struct
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path, PurePosixPath

import mujoco

from tableverse_factory.core.errors import InputError
from tableverse_factory.core.text import describe_error, sanitize_line
from tableverse_factory.geometry.mesh.meshes import MAX_PIXELS
from tableverse_factory.physics.mjcf.validate_model import check_finite, raise_on_nan

MAX_DOCUMENT_BYTES = 64 * 1024 * 1024
MAX_DOCUMENTS = 64
MAX_REFERENCES = 20_000
MAX_SETTINGS = 64
MAX_LOOKUPS = 1_000_000  # of paths, in all possible folders
MAX_TOTAL_BYTES = 2 * 1024**3

_ATTRIBUTE = re.compile(rb"\b(file\w*|meshdir|texturedir|assetdir)\s*=\s*(?:\"([^\"]*)\"|'([^']*)')")
_ENTITY = re.compile(r"&(?:#x([0-9a-fA-F]{1,20})|#([0-9]{1,20})|(quot|amp|apos|lt|gt));")  # as in MuJoCo's XML reader
_NAMED_ENTITIES = {"quot": '"', "amp": "&", "apos": "'", "lt": "<", "gt": ">"}
# Characters that may end a name early, invalid entities, and drives, which Linux takes for folders.
_UNREADABLE = re.compile(r"[\x00-\x1f\x7f]|&#|^\s*[A-Za-z]:[\\/]")


def load_mjcf(path: Path, root: Path | None = None) -> mujoco.MjModel:
    """Load the model of a file on disk; all files that it names must lie below `root`, by default its own folder.

    Raises:
        InputError: `bad_mjcf` if it names others or too many bytes, does not load, or holds a NaN or infinite number.
    """
    try:
        check_files(path, root or path.parent)
        with raise_on_nan():
            model = mujoco.MjModel.from_xml_path(str(path))
        check_finite(model)
        return model
    except InputError as error:
        raise InputError(f"{path.name}: {error}", error.reason) from None
    except ValueError as error:
        raise InputError(f"{path.name}: MuJoCo does not load it: {describe_error(error)[:400]}", "bad_mjcf") from None


def check_files(path: Path, root: Path) -> tuple[Path, ...]:
    """List the files that a document may read, itself first.

    Raises:
        InputError: `bad_mjcf` for one outside `root`, one that is no regular file, or too much of anything.
    """
    if path.is_file() and path.stat().st_size > MAX_DOCUMENT_BYTES:
        raise InputError(f"give a file of at most {MAX_DOCUMENT_BYTES} bytes", "bad_mjcf")
    search = _FileSearch(root.resolve())
    search.add(path, sanitize_line(path.name))
    search.check_absent()
    return tuple(search.files)


def check_references(document: bytes, files: Collection[str]) -> None:
    """Check that an exported scene in memory names only these files: MuJoCo would open all others on the disk.

    Raises:
        InputError: `bad_mjcf` for any other.
    """
    for name, value in _find_attributes(document):
        # in every reading, as written too: MuJoCo opens unknown names on the disk
        known = f"assets/{value}" in files or value in files if name.startswith("file") else value in ("", "assets")
        if not known:
            raise InputError(f"scene.xml names {sanitize_line(value, 80)!r}, which is none of its files", "bad_mjcf")


@dataclass(slots=True)
class _FileSearch:
    """Search through documents that name documents: every path is tried in every folder known so far.

    `homes` are the folders of the documents; `settings` the folders, and `references` the paths that they name, in
    every reading.
    """

    root: Path
    files: dict[Path, None] = field(default_factory=dict)
    homes: dict[Path, None] = field(default_factory=dict)
    settings: dict[str, None] = field(default_factory=lambda: {"": None})
    references: dict[str, None] = field(default_factory=dict)
    documents: int = 0
    size: int = 0

    def add(self, path: Path, called: str) -> None:
        """Add an existing file, and all that it names if it is a document."""
        if path in self.files:
            return
        if not path.resolve().is_relative_to(self.root):
            raise self._outside(called)
        if not path.is_file():
            raise InputError(f"{called!r} is no regular file", "bad_mjcf")
        self.files[path] = None
        self.size += path.stat().st_size
        if self.size > MAX_TOTAL_BYTES:
            raise InputError(f"with {called!r} more than {MAX_TOTAL_BYTES} bytes would be read", "bad_mjcf")
        if path.stat().st_size:  # nothing cannot be mapped
            with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
                _check_picture_size(data, called)
                attributes = list(islice(_find_attributes(data), MAX_REFERENCES + 1))
            self._follow(path, called, attributes)

    def _follow(self, path: Path, called: str, attributes: Collection[tuple[str, str]]) -> None:
        """Follow the paths that a file names; MuJoCo includes files of any ending."""
        if not attributes:
            return
        self.documents += 1
        if self.documents > MAX_DOCUMENTS or path.stat().st_size > MAX_DOCUMENT_BYTES:
            most = f"at most {MAX_DOCUMENTS} documents of at most {MAX_DOCUMENT_BYTES} bytes are read"
            raise InputError(f"{called!r}: {most}", "bad_mjcf")
        known_bases, known_references = self._bases(), tuple(self.references)
        self.homes[path.parent] = None
        for name, value in attributes:
            (self.references if name.startswith("file") else self.settings)[value] = None
        looks = len(self.homes) * len(self.settings) * len(self.references)
        if len(self.references) > MAX_REFERENCES or len(self.settings) > MAX_SETTINGS or looks > MAX_LOOKUPS:
            raise InputError(f"{called!r} names too many files or folders", "bad_mjcf")
        bases, references = self._bases(), tuple(self.references)
        self._find(references[len(known_references) :], bases)
        self._find(known_references, [base for base in bases if base not in known_bases])

    def check_absent(self) -> None:
        """Refuse paths that leave the folder from every base, whether they exist or not."""
        bases = self._bases()
        known = {path.name for path in self.files}  # `strippath` may leave only the name
        for value in self.references:
            paths = (Path(os.path.realpath(os.path.normpath(base / value))) for base in bases)
            if PurePosixPath(value).name not in known and not any(path.is_relative_to(self.root) for path in paths):
                raise self._outside(sanitize_line(value, 80))

    def _outside(self, called: str) -> InputError:
        return InputError(
            f"it names {called!r}, which lies outside {str(self.root)!r}: bring it into that folder, or widen it "
            "with --root where there is such an option",
            "bad_mjcf",
        )

    def _bases(self) -> dict[Path, None]:
        return dict.fromkeys(home / setting for home in self.homes for setting in self.settings)

    def _find(self, references: Collection[str], bases: Collection[Path]) -> None:
        for value in references:
            for name in dict.fromkeys((value, PurePosixPath(value).name)):  # `strippath` leaves the name alone
                for path in (base / name for base in bases if name):
                    self._look(path, sanitize_line(value, 80))

    def _look(self, path: Path, called: str) -> None:
        """Add the file at this path, if there is one: where MuJoCo looks, and where the system would."""
        reduced = Path(os.path.normpath(path))
        if _is_file_like(reduced):
            self.add(reduced, called)
        if reduced != path and _is_file_like(path) and os.path.realpath(path) != os.path.realpath(reduced):
            self.add(path, called)


def _is_file_like(path: Path) -> bool:
    try:
        return path.exists() and not path.is_dir()
    except OSError:  # a name too long: MuJoCo cannot open it either
        return False


def _check_picture_size(data: mmap.mmap, called: str) -> None:
    if data[:8] == b"\x89PNG\r\n\x1a\n" and len(data) >= 24:
        width, height = struct.unpack(">II", data[16:24])
        if width * height > MAX_PIXELS:
            raise InputError(f"{called!r}: {width} x {height} pixels; at most {MAX_PIXELS} are decoded", "bad_mjcf")


def _find_attributes(document: bytes | mmap.mmap) -> Iterator[tuple[str, str]]:
    """Find every attribute that names a file or folder, in every reading, also in comments; others are refused."""
    for match in _ATTRIBUTE.finditer(document):
        written = os.fsdecode(match[2] if match[2] is not None else match[3])
        meant = _ENTITY.sub(_decode_entity, written)
        if _UNREADABLE.search(meant):
            raise InputError(f"it names {sanitize_line(written, 80)!r}, which is no plain path", "bad_mjcf")
        values = (written, meant, written.strip(), meant.strip())
        for value in dict.fromkeys(value.replace("\\", "/") for value in values):
            yield match[1].decode(), value


def _decode_entity(entity: re.Match[str]) -> str:
    """Decode an entity; NUL for invalid characters."""
    if entity[3] is not None:
        return _NAMED_ENTITIES[entity[3]]
    code = int(entity[1], 16) if entity[1] is not None else int(entity[2])
    return chr(code) if code < 0xD800 or 0xE000 <= code <= 0x10FFFF else "\0"
