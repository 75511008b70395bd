"""Scenes in models of Newton, read by its own importer of MJCF."""

import tempfile
from pathlib import Path
from typing import Any

from tableverse_factory.core.optional_imports import import_extra
from tableverse_factory.dataset.dataset import Scene
from tableverse_factory.physics.mjcf.load import load_spec

_READ = ("scene.xml", "assets/")


def add_to_newton(builder: Any, scene: Scene, visuals: bool = True) -> None:
    """Add a scene to a `newton.ModelBuilder`, its table frame in the origin.

    Newton takes meshes for surfaces, and looks for contacts 10 cm around them: a scene has a hundred thousand contacts
    then. So the pieces, which are convex, become hulls, and the gap of the scene's shapes is 0.

    Raises:
        InputError: `no_extra` without newton, `bad_mjcf` if the scene names files that are not its own.
    """
    newton = import_extra("newton", "add_to_newton", "newton")
    files = scene.files()
    load_spec(files)  # refuses foreign files, which Newton would open
    newton.solvers.SolverMuJoCo.register_custom_attributes(builder)
    first, gap = builder.shape_count, builder.rigid_gap
    builder.rigid_gap = 0.0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for path, data in files.items():
            if path.startswith(_READ):
                (folder / path).parent.mkdir(exist_ok=True)
                (folder / path).write_bytes(data)
        builder.add_mjcf(str(folder / "scene.xml"), parse_visuals=visuals)
    builder.rigid_gap = gap
    solid = newton.ShapeFlags.COLLIDE_SHAPES
    pieces = [k for k in range(first, builder.shape_count) if builder.shape_flags[k] & solid]
    builder.approximate_meshes("convex_hull", shape_indices=pieces)


class NewtonScene:
    """A scene in Newton: its collision detection, and its solver of MuJoCo's equations (`SolverMuJoCo`).

    Attributes:
        model: `newton.Model`.
        solver: `newton.solvers.SolverMuJoCo`, with contacts of `pipeline`.
        state: `newton.State`, which `step` advances; its arrays may be written between steps.
        contacts: Those of the last step's beginning.
    """

    def __init__(self, scene: Scene, device: str | None = None) -> None:
        """Load a scene on a device of Warp; by default Warp's own choice."""
        newton = import_extra("newton", "NewtonScene", "newton")
        self._warp = import_extra("warp", "NewtonScene", "newton")
        self.timestep_s = float(scene.model().opt.timestep)
        with self._warp.ScopedDevice(device):
            builder = newton.ModelBuilder()
            add_to_newton(builder, scene, visuals=False)
            self.model = builder.finalize()
            self.state, self._next = self.model.state(), self.model.state()
            newton.eval_fk(self.model, self.model.joint_q, self.model.joint_qd, self.state)
            self.pipeline = newton.CollisionPipeline(self.model, broad_phase="explicit", reduce_contacts=False)
            self.contacts = self.pipeline.contacts()
            self.pipeline.collide(self.state, self.contacts)
            found = int(self.contacts.rigid_contact_count.numpy()[0])
            room = 64 + 2 * found  # things that are pushed together touch more often than at rest
            self.solver = newton.solvers.SolverMuJoCo(
                self.model, use_mujoco_contacts=False, nconmax=room, njmax=6 * room
            )

    def step(self, steps: int = 1) -> None:
        """Step by the scene's timestep."""
        with self._warp.ScopedDevice(self.model.device):
            for _ in range(steps):
                self.state.clear_forces()
                self.pipeline.collide(self.state, self.contacts)
                self.solver.step(self.state, self._next, None, self.contacts, self.timestep_s)
                self.state, self._next = self._next, self.state
