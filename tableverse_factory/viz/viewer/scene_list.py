"""The list of scenes in one browser: search, status, a scene or a page back and on."""

from tableverse_factory.viz.viewer.facts import said_html
from tableverse_factory.viz.viewer.panel import BACK, NEXT, NO_MATCH, PAGE_BACK, PAGE_NEXT, Panel
from tableverse_factory.viz.viewer.scene_cache import SceneCache

PAGE = 50
"""Scenes that the list offers at once."""

_STEPS = {PAGE_BACK: -PAGE, BACK: -1, NEXT: 1, PAGE_NEXT: PAGE}


class SceneList:
    """What was searched for, and what was found."""

    def __init__(self, panel: Panel, shelf: SceneCache) -> None:
        """Finds all scenes.

        Args:
            panel: The controls.
            shelf: The scenes.
        """
        self._panel, self._shelf = panel, shelf
        self._found = shelf.search("", panel.status.value)

    def search(self, current: str) -> str | None:
        """Searches as the controls say.

        Args:
            current: The scene that is shown.

        Returns:
            The scene to show instead; None where the one that is shown was found too, or none was.

        Raises:
            InputError: if the table of objects does not read.
        """
        self._found = self._shelf.search(self._panel.search.value, self._panel.status.value)
        return self._found.beside(current, 0) if self._found.place(current) < 0 else None

    def beside(self, current: str) -> str | None:
        """The scene that the last press of a button leads to; None where it leads nowhere."""
        other = self._found.beside(current, _STEPS.get(self._panel.step.value, 0))
        return other if other != current else None

    def show(self, current: str) -> None:
        """Offers the page on which a scene lies, and the scene itself also where it was not found."""
        panel, place = self._panel, self._found.place(current)
        options = self._found.window(current, PAGE) or [NO_MATCH]
        if place < 0 and current:
            options = [current, *options]
        panel.scene.options = options
        if current in options:
            panel.scene.value = current
        where = f"{place + 1:,} of " if place >= 0 else ""
        panel.place.content = said_html(f"{where}{len(self._found):,} scenes found, {len(self._shelf):,} in all")
