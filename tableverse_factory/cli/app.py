"""Order of the commands, and the text of `tableverse` without a command."""

from typing import Any

from typer.core import TyperGroup

from tableverse_factory.core.version import __version__

FIRST_STEPS = """\
TableVerse Factory {version}: table-top pictures become certified MuJoCo scenes.

First steps:
  tableverse doctor                                   check this machine
  tableverse synth captures                           synthetic captures to try it with
  tableverse manifest captures --out images.parquet   check the captures
  tableverse build images.parquet out                 build the dataset
  tableverse report out                               a gallery for the browser
  tableverse view out                                 an interactive 3D view of a scene
  tableverse status out                               progress of the build

With pictures of your own: tableverse init FOLDER says where they belong.
All commands: tableverse --help. One of them, with an example: tableverse build --help
"""


class OrderedGroup(TyperGroup):
    """Group of commands that lists them in the order of their table."""

    order: tuple[str, ...] = ()

    def list_commands(self, ctx: Any) -> list[str]:
        """List the names of the commands in order."""
        return sorted(super().list_commands(ctx), key=self.order.index)


def format_first_steps() -> str:
    """Format the shortest way to a dataset."""
    return FIRST_STEPS.format(version=__version__)
