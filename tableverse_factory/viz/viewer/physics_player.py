"""Physics playback of one browser: run, push, reset, contacts."""

from collections.abc import Mapping

import numpy as np

from tableverse_factory.core.errors import InputError
from tableverse_factory.viz.viewer.layouts import Poses
from tableverse_factory.viz.viewer.loaded_scene import LoadedScene
from tableverse_factory.viz.viewer.panel import NO_MATCH, Panel
from tableverse_factory.viz.viewer.panel_html import format_status
from tableverse_factory.viz.viewer.simulation import Contacts, Simulation

MAX_OBJECTS = 200
_PUSHES = {"left": (-1.0, 0.0, 0.0), "right": (1.0, 0.0, 0.0), "away": (0.0, 1.0, 0.0), "up": (0.0, 0.0, 1.0)}
_SLOW = 0.9  # share of the chosen speed below which the panel reports it


class PhysicsPlayer:
    """The simulation of the shown scene, and a second one for contacts at fixed poses."""

    def __init__(self, panel: Panel) -> None:
        self._panel = panel
        self._simulation: Simulation | None = None
        self._fixed: Simulation | None = None
        self._masses: dict[str, float] = {}
        self.running = False

    @property
    def time_s(self) -> float:
        """Simulated time since the last reset [s]."""
        return self._simulation.time_s if self._simulation is not None else 0.0

    def close(self) -> None:
        """Remove the scene."""
        self._simulation, self._fixed, self._masses, self.running = None, None, {}, False

    def open(self, loaded: LoadedScene, names: Mapping[str, str]) -> None:
        """Set the scene, as exported, with the display names of its objects by id."""
        self._simulation, self._fixed = Simulation(loaded.model), Simulation(loaded.model)
        self._masses = {body.name: body.mass_kg for body in loaded.bodies}
        options = [f"{name} {names.get(name, '')}" for name in list(self._masses)[:MAX_OBJECTS]]
        self._panel.target.options = options or [NO_MATCH]
        self.show_status()

    def reset(self, poses: Poses) -> None:
        """Reset the objects to poses at rest."""
        if self._simulation is not None:
            self._simulation.reset(poses)

    def push(self) -> bool:
        """Push the object chosen in the controls; return whether there is one."""
        name = self._panel.target.value.partition(" ")[0]
        if name not in self._masses or self._simulation is None:
            return False
        direction = np.array(_PUSHES.get(self._panel.push.value, (0.0, 0.0, 0.0)))
        self._simulation.push(name, self._masses[name] * self._panel.strength.value * direction)
        return True

    def advance(self, seconds: float, budget_s: float) -> float:
        """Simulate some seconds within a budget of wall time [s]; return the share of them that it allowed."""
        if self._simulation is None or seconds <= 0.0:
            return 1.0
        passed = self._simulation.advance(seconds, budget_s)
        if self._simulation.unstable:
            raise InputError("the simulation became unstable and was stopped: reset it")
        return passed / seconds

    def poses(self) -> Poses:
        """Return the poses of the objects."""
        return self._simulation.poses() if self._simulation is not None else {}

    def contacts(self, poses: Poses | None) -> Contacts:
        """Measure the contacts at fixed poses at rest; None for the state of the simulation."""
        if self._simulation is None or self._fixed is None:
            return Contacts(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0), 0)
        if poses is None:
            return self._simulation.contacts()
        self._fixed.reset(poses)
        return self._fixed.contacts(shown=poses)

    def show_status(self, share: float = 1.0) -> None:
        """Show the simulated time, and the share of the chosen speed where it is lower."""
        slow = f", {100 * share:.0f} % of the chosen speed" if share < _SLOW else ""
        self._panel.physics_status.content = format_status(f"{self.time_s:.1f} s simulated{slow}")
