"""The physics that one browser plays: run, pushed, put back, and what touches."""

from collections.abc import Mapping

import numpy as np

from tableverse_factory.core.errors import InputError
from tableverse_factory.viz.viewer.facts import said_html
from tableverse_factory.viz.viewer.layouts import Poses
from tableverse_factory.viz.viewer.loaded_scene import OpenedScene
from tableverse_factory.viz.viewer.panel import NO_MATCH, Panel
from tableverse_factory.viz.viewer.simulation import Contacts, Simulation

MAX_OBJECTS = 200
_PUSHES = {"left": (-1.0, 0.0, 0.0), "right": (1.0, 0.0, 0.0), "away": (0.0, 1.0, 0.0), "up": (0.0, 0.0, 1.0)}
_SLOW = 0.9
"""Of the speed asked for: below, it is said."""


class PhysicsPlayer:
    """One simulation of the opened scene."""

    def __init__(self, panel: Panel) -> None:
        """Has nothing to simulate.

        Args:
            panel: The controls.
        """
        self._panel = panel
        self._simulation: Simulation | None = None
        self._held: Simulation | None = None
        self._masses: dict[str, float] = {}
        self.running = False

    @property
    def time_s(self) -> float:
        """Simulated since the objects were last put down [s]."""
        return self._simulation.time_s if self._simulation is not None else 0.0

    def close(self) -> None:
        """Has nothing to simulate."""
        self._simulation, self._held, self._masses, self.running = None, None, {}, False

    def open(self, opened: OpenedScene, names: Mapping[str, str]) -> None:
        """Takes a scene as exported.

        Args:
            opened: The scene.
            names: Of its objects, in words.
        """
        self._simulation, self._held = Simulation(opened.model), Simulation(opened.model)
        self._masses = {figure.name: figure.mass_kg for figure in opened.figures}
        options = [f"{name} {names.get(name, '')}" for name in list(self._masses)[:MAX_OBJECTS]]
        self._panel.target.options = options or [NO_MATCH]
        self.say()

    def put(self, poses: Poses) -> None:
        """Puts the objects down at rest."""
        if self._simulation is not None:
            self._simulation.put(poses)

    def push(self) -> bool:
        """Pushes the object that the controls name as they say; whether there is one."""
        name = self._panel.target.value.partition(" ")[0]
        if name not in self._masses or self._simulation is None:
            return False
        direction = np.array(_PUSHES.get(self._panel.push.value, (0.0, 0.0, 0.0)))
        self._simulation.push(name, self._masses[name] * self._panel.strength.value * direction)
        return True

    def advance(self, seconds: float, budget_s: float) -> float:
        """Simulates.

        Args:
            seconds: To simulate [s].
            budget_s: Of the wall's time [s].

        Returns:
            The share of it that the budget was enough for.

        Raises:
            InputError: if the simulation became unstable.
        """
        if self._simulation is None or seconds <= 0.0:
            return 1.0
        passed = self._simulation.advance(seconds, budget_s)
        if self._simulation.unstable:
            raise InputError("the simulation became unstable and was stopped: reset it")
        return passed / seconds

    def poses(self) -> Poses:
        """Where the objects are now."""
        return self._simulation.poses() if self._simulation is not None else {}

    def contacts(self, poses: Poses | None) -> Contacts:
        """What touches.

        Args:
            poses: Of objects that are held in another place than the simulation's, at rest; None for the simulation's.
        """
        if self._simulation is None or self._held is None:
            return Contacts.none()
        if poses is None:
            return self._simulation.contacts()
        self._held.put(poses)
        return self._held.contacts(shown=poses)

    def say(self, share: float = 1.0) -> None:
        """Says how much was simulated, and whether it is slower than asked for."""
        slow = f", {100 * share:.0f} % of the speed asked for" if share < _SLOW else ""
        self._panel.physics_said.content = said_html(f"{self.time_s:.1f} s simulated{slow}")
