"""Pages of a gallery from templates, which escape all values."""

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from tableverse_factory.core.errors import InputError
from tableverse_factory.core.storage.files import write_atomic
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.core.version import __version__
from tableverse_factory.viz.gallery.formatting import FILTERS


@dataclass(frozen=True, slots=True)
class Site:
    """Data that all pages of a gallery share."""

    folder: Path
    dataset: str
    out: str  # absolute path or address of the dataset
    n_done: int  # scenes with a page
    n_lost: int  # scenes listed with their reason
    n_rendered: int  # scenes drawn from every side, the first ones

    @property
    def renders_all(self) -> bool:
        """Whether every scene is drawn from every side."""
        return self.n_rendered >= self.n_done

    @property
    def named(self) -> str:
        """Name of the dataset on pages: for a folder without its path, which differs for other readers."""
        return self.out if "://" in self.out else self.dataset

    def render(self, name: str, template: str, **context: Any) -> bytes:
        """Render the page that is to have this name."""
        root = "../" * name.count("/")
        page = _load_templates().get_template(template)
        html = page.render(site=self, root=root, version=__version__, lost_name=make_lost_name(1), **context)
        # JSON may hold lone surrogates, which UTF-8 cannot encode.
        return html.encode("utf-8", errors="backslashreplace")

    def write(self, name: str, template: str, **context: Any) -> None:
        """Write one page."""
        self.write_file(name, self.render(name, template, **context))

    def write_file(self, name: str, data: bytes) -> None:
        """Write a file, whole, unless it is already there with these bytes."""
        path = self.folder / name
        if not path.is_file() or path.read_bytes() != data:
            write_atomic(path, data)

    def describe_error(self, error: Exception) -> str:
        """Describe an error without the path of the dataset; unexpected errors with their type."""
        text = str(error) if isinstance(error, InputError | ValueError) else f"{type(error).__name__}: {error}"
        return sanitize_line(text.replace(self.out, self.named), 500)


def make_page_name(number: int) -> str:
    """Make the file name of a page of cards, counted from 1."""
    return "index.html" if number == 1 else f"page-{number:04d}.html"


def make_lost_name(number: int) -> str:
    """Make the file name of a page of lost scenes, counted from 1."""
    return "lost.html" if number == 1 else f"lost-{number:04d}.html"


def name_scene_page(scene_id: str) -> str:
    """Name the page of a scene."""
    return f"scenes/{scene_id}.html"


@cache
def _load_templates() -> Environment:
    templates = Environment(
        loader=PackageLoader("tableverse_factory.viz.gallery"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    templates.filters.update(FILTERS)
    templates.globals["page_name"] = make_page_name
    return templates
