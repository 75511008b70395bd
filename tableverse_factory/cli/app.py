"""What stands above the commands: their order, and what is said to who names none."""

from typing import Any

from typer.core import TyperGroup

from tableverse_factory.core.version import __version__

FIRST_STEPS = """\
TableVerse Factory {version}: table-top pictures become certified MuJoCo scenes.

First steps:
  tableverse doctor                                   is all here that is needed?
  tableverse synth captures                           captures to try it with
  tableverse manifest captures --out images.parquet   what can be used, and why not
  tableverse build images.parquet out                 the dataset
  tableverse report out                               a gallery for the browser
  tableverse view out                                 a scene of it, to turn and to touch
  tableverse status out                               where a build stands

With pictures of your own: tableverse init FOLDER says where they belong.
All commands: tableverse --help. One of them, with an example: tableverse build --help
"""


class OrderedGroup(TyperGroup):
    """The commands in the order of their table, groups of commands among them."""

    order: tuple[str, ...] = ()

    def list_commands(self, ctx: Any) -> list[str]:
        """The names, in order."""
        return sorted(super().list_commands(ctx), key=self.order.index)


def format_first_steps() -> str:
    """The shortest way to a dataset, for who typed `tableverse` alone."""
    return FIRST_STEPS.format(version=__version__)
