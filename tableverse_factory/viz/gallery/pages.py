"""The pages of a gallery out of their templates, which escape whatever they are given."""

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from tableverse_factory import __version__
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.viz.gallery.words import FILTERS

_LONGEST = 500


@dataclass(frozen=True, slots=True)
class Site:
    """What all pages of a gallery have in common.

    Attributes:
        folder: Where they lie.
        dataset: Its name.
        out: Where it is read: its folder from the root on, or its address.
        n_done: Scenes with a page.
        n_lost: Scenes that are listed with their reason.
        n_rendered: Scenes that are drawn from every side, the first ones.
    """

    folder: Path
    dataset: str
    out: str
    n_done: int
    n_lost: int
    n_rendered: int

    @property
    def renders_all(self) -> bool:
        """Whether every scene is drawn from every side."""
        return self.n_rendered >= self.n_done

    @property
    def named(self) -> str:
        """As pages name it: of a folder the name alone, since those whom they are sent to have it elsewhere."""
        return self.out if "://" in self.out else self.dataset

    def write(self, name: str, template: str, **context: Any) -> None:
        """Writes one page."""
        root = "../" * name.count("/")
        page = _templates().get_template(template)
        html = page.render(site=self, root=root, version=__version__, lost_name=lost_name(1), **context)
        # JSON may hold half a character, which UTF-8 has no bytes for.
        (self.folder / name).write_text(html, encoding="utf-8", errors="backslashreplace")

    def told(self, error: Exception) -> str:
        """What an error says, without the folder that the dataset lies in; with its type where it was not foreseen."""
        said = str(error) if isinstance(error, InputError | ValueError) else f"{type(error).__name__}: {error}"
        return sanitize_line(said.replace(self.out, self.named), _LONGEST)


def page_name(number: int) -> str:
    """Of a page of cards, counted from 1."""
    return "index.html" if number == 1 else f"page-{number:04d}.html"


def lost_name(number: int) -> str:
    """Of a page of lost scenes, counted from 1."""
    return "lost.html" if number == 1 else f"lost-{number:04d}.html"


@cache
def _templates() -> Environment:
    templates = Environment(
        loader=PackageLoader("tableverse_factory.viz.gallery"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    templates.filters.update(FILTERS)
    templates.globals["page_name"] = page_name
    return templates
