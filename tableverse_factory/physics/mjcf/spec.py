"""A scene as an MjSpec: bodies named by their object ids, on a slab. The only place where MJCF is made.

Settings for stable rest, all in the XML: implicitfast; elliptic cones with impratio 100 (a leaning object creeps
twelve times slower than at 10, at no cost); five no-slip iterations; condim 6 with torsional and rolling friction;
contacts so stiff that a stack sinks in by hundredths of a millimetre instead of MuJoCo's default tenths.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import mujoco
import numpy as np
from jaxtyping import Float64

from schemas.geometry import Frozen, Pose, Quaternion, TriangleMesh, Vector3
from schemas.identity import make_file_stem
from tableverse_factory.core.png import encode_png
from tableverse_factory.geometry.math.camera import PosedCamera
from tableverse_factory.geometry.math.transforms import OPENCV_TO_OPENGL, multiply_quaternions, quaternion_about_z
from tableverse_factory.geometry.mesh.mass_integrals import encloses_volume
from tableverse_factory.physics.mjcf.inertia import MassProperties
from tableverse_factory.physics.mjcf.obj_assets import Appearance, encode_piece, encode_visual
from tableverse_factory.physics.mjcf.portable_xml import make_portable_xml
from tableverse_factory.physics.mjcf.shape import make_body_shape
from tableverse_factory.physics.mjcf.slab import THICKNESS_M, Slab

ASSETS = "assets"
TABLE, BACKDROP = "table", "backdrop"
VISUAL_GROUP, COLLISION_GROUP, TABLE_GROUP = 2, 3, 1
TORSIONAL_FRICTION = ROLLING_FRICTION = 0.01
TABLE_FRICTION = 0.8
TABLE_ROLLING_FRICTION = 1e-4  # a contact takes the larger of two frictions: the object decides how it rolls
# Time constant [s] and impedance of a contact: at no depth, deep, and the depth between them [m]. MuJoCo is stable down
# to two steps. Things of a table sink in by less than 0.1 mm, and by 0.4 mm at MuJoCo's defaults. The depth grows with
# the load over the lighter mass: 0.1 mm for 500 times the mass, 0.6 mm for 15,000 times (30 kg on 2 g).
CONTACT_TIME_S = 0.004
IMPEDANCE = (0.99, 0.999, 0.0002)
REST_OPTIONS = {
    "integrator": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
    "cone": mujoco.mjtCone.mjCONE_ELLIPTIC,
    "impratio": 100.0,
    "noslip_iterations": 5,
}

# Lamp over the table's middle, of the strength of the viewer's own lamp and of what comes from everywhere.
LIGHT, TO_LIGHT = 0.45, np.array([-0.6, -0.8, 1.7])

_PIXEL_M = 5e-6  # MuJoCo wants the size of a camera's sensor for its focal length and principal point in pixels

_TETRAHEDRON_OBJ = (
    b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nvt 0 0\nf 1/1 3/1 2/1\nf 1/1 2/1 4/1\nf 1/1 4/1 3/1\nf 2/1 3/1 4/1\n"
)
_PLACEHOLDERS = "placeholders"
_PIXEL_PNG = encode_png(np.zeros((1, 1, 3), dtype=np.uint8))


@dataclass(frozen=True, slots=True, eq=False)
class SceneBody(Frozen):
    """One object, ready for export: mesh, pieces and mass properties in its own frame, scaled [m], `pose` on the table.

    Attributes:
        appearance: Its texture; None for the uniform `color`.
        dropped_pieces: How many convex pieces were too thin to simulate.
    """

    object_id: str
    mesh: TriangleMesh
    hulls: tuple[TriangleMesh, ...]
    properties: MassProperties
    pose: Pose
    friction: float = TABLE_FRICTION
    rolling_friction: float = ROLLING_FRICTION
    color: tuple[int, int, int] = (178, 178, 184)
    appearance: Appearance | None = None
    dropped_pieces: int = 0

    def with_mass(self, mass_kg: float) -> "SceneBody":
        """Set the mass by the density."""
        return replace(self, properties=self.properties.with_mass(mass_kg))


@dataclass(frozen=True, slots=True)
class TableTexture:
    """A picture repeated over the table, its rows against the slab's y axis; `tile_m` along x and y [m]."""

    texture_png: bytes
    tile_m: tuple[float, float]
    tint: float = 1.0  # factor of the texture


@dataclass(frozen=True, slots=True, eq=False)
class Backdrop(Frozen):
    """A picture that stands behind the table and touches nothing; pose in the table frame, axes of a camera's image."""

    texture_png: bytes
    center: Vector3
    quaternion_wxyz: Quaternion
    half_size_xy: Float64[np.ndarray, "2"]
    tint: float  # factor of the texture


@dataclass(frozen=True, slots=True)
class SceneFiles:
    """MJCF text and the files it names, by their path beside it."""

    xml: str
    assets: dict[str, bytes] = field(default_factory=dict)

    def model(self) -> mujoco.MjModel:
        """Compile the model from these files alone."""
        spec = mujoco.MjSpec.from_string(self.xml, assets=self.assets)
        spec.compiler.usethread = False
        return spec.compile()


def make_scene_body(
    object_id: str, mesh: TriangleMesh, hulls: tuple[TriangleMesh, ...], scale: float, mass_kg: float, pose: Pose
) -> SceneBody:
    """Make a body of a mesh and its pieces at `scale`; GeometryError if no piece is thick enough to simulate."""
    shape = make_body_shape(mesh, hulls, scale)
    properties, thin = shape.moments.of_mass(mass_kg), len(hulls) - len(shape.hulls)
    return SceneBody(object_id, shape.mesh, shape.hulls, properties, pose, dropped_pieces=thin)


def quantize_pose(pose: Pose) -> Pose:
    """Round a pose to 12 decimals, as it is written."""
    return Pose(np.round(pose.position, 12) + 0.0, np.round(pose.quaternion_wxyz, 12) + 0.0)


def make_scene_files(
    bodies: Sequence[SceneBody],
    slab: Slab,
    *,
    model_name: str = "scene",
    timestep_s: float = 0.002,
    view: PosedCamera | None = None,
    tabletop: TableTexture | None = None,
    backdrop: Backdrop | None = None,
) -> SceneFiles:
    """Make MJCF text with its assets, visual meshes and textures included."""
    spec, assets = _make_spec(bodies, slab, model_name, timestep_s, visuals=True)
    if tabletop is not None:
        _cover_table(spec, slab, tabletop, assets)
    if backdrop is not None:
        _add_backdrop(spec, backdrop, assets)
    if view is not None:
        _add_camera(spec, view)
    # MuJoCo writes the XML of compiled models only, and only the names of files: placeholders compile at once, in a
    # folder of their own, as MuJoCo caches what each path held last. `SceneFiles.model` compiles the real files.
    spec.meshdir = spec.texturedir = _PLACEHOLDERS
    spec.assets = {
        name.replace(ASSETS, _PLACEHOLDERS, 1): _TETRAHEDRON_OBJ if name.endswith(".obj") else _PIXEL_PNG
        for name in assets
    }
    spec.compile()
    spec.compiler.usethread = True  # the XML does not bind its readers
    xml = spec.to_xml().replace(f'dir="{_PLACEHOLDERS}"', f'dir="{ASSETS}"')
    exact = {body.object_id: (quantize_pose(body.pose), body.properties) for body in bodies}
    return SceneFiles(make_portable_xml(xml, exact), assets)


def compute_irradiance(normal: Vector3, to_eye: Vector3) -> float:
    """Compute by which factor a texture is lit on the table's middle, for unit vectors."""
    to_light = TO_LIGHT / np.linalg.norm(TO_LIGHT)
    return LIGHT * (1.0 + max(float(normal @ to_eye), 0.0) + max(float(normal @ to_light), 0.0))


def make_simulation_spec(bodies: Sequence[SceneBody], slab: Slab, timestep_s: float = 0.002) -> mujoco.MjSpec:
    """Make the scene without its looks: it simulates the same and compiles faster."""
    spec, assets = _make_spec(bodies, slab, "scene", timestep_s, visuals=False)
    spec.assets = assets
    return spec


def _make_spec(
    bodies: Sequence[SceneBody], slab: Slab, model_name: str, timestep_s: float, *, visuals: bool
) -> tuple[mujoco.MjSpec, dict[str, bytes]]:
    """Make the spec, and its files, which it has not got yet."""
    spec = mujoco.MjSpec()
    spec.modelname = model_name
    spec.meshdir = spec.texturedir = ASSETS
    spec.compiler.usethread = False  # the compiler's threads take a fifth more CPU time
    _set_options(spec, timestep_s)
    assets: dict[str, bytes] = {}
    _add_table(spec, slab)
    for body in bodies:
        part = _add_body(spec, body, assets)
        if visuals:
            _add_visual(spec, part, body, assets)
    return spec, assets


def _set_options(spec: mujoco.MjSpec, timestep_s: float) -> None:
    spec.option.timestep = timestep_s
    for name, value in REST_OPTIONS.items():
        setattr(spec.option, name, value)
    visual = spec.add_default("visual", spec.default).geom
    visual.group, visual.contype, visual.conaffinity = VISUAL_GROUP, 0, 0
    collision = spec.add_default("collision", spec.default).geom
    collision.group, collision.condim = COLLISION_GROUP, 6
    collision.friction = [TABLE_FRICTION, TORSIONAL_FRICTION, ROLLING_FRICTION]
    collision.solref[0] = max(CONTACT_TIME_S, 2 * timestep_s)
    collision.solimp[:3] = IMPEDANCE
    light = spec.visual.headlight
    light.ambient, light.diffuse, light.specular = [LIGHT] * 3, [LIGHT] * 3, [0.1, 0.1, 0.1]
    spec.visual.global_.offwidth, spec.visual.global_.offheight = 1280, 960
    sky = spec.add_texture(name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, width=128, height=768)
    sky.builtin, sky.rgb1, sky.rgb2 = mujoco.mjtBuiltin.mjBUILTIN_GRADIENT, [0.93, 0.95, 0.98], [0.55, 0.6, 0.68]


def _add_table(spec: mujoco.MjSpec, slab: Slab) -> None:
    body = spec.worldbody.add_body(name=TABLE)
    body.pos = [*slab.center_xy, -THICKNESS_M / 2]
    body.quat = quaternion_about_z(slab.yaw)
    top = body.add_geom(spec.find_default("collision"), name=TABLE, type=mujoco.mjtGeom.mjGEOM_BOX)
    top.size = [*slab.half_size_xy, THICKNESS_M / 2]
    top.group = TABLE_GROUP
    top.friction = [TABLE_FRICTION, TORSIONAL_FRICTION, TABLE_ROLLING_FRICTION]
    top.rgba = [*(np.array(slab.color) / 255.0), 1.0]
    # A spot: MuJoCo 3.3 and 4 name directional lights differently.
    light = spec.worldbody.add_light(name="key")
    to_light = TO_LIGHT * max(1.0, float(np.linalg.norm(slab.half_size_xy)))
    light.pos, light.dir = np.array([*slab.center_xy, 0.0]) + to_light, -to_light
    light.diffuse, light.specular, light.cutoff, light.exponent = [LIGHT, LIGHT, 0.43], [0.1, 0.1, 0.1], 60.0, 1.0


def _cover_table(spec: mujoco.MjSpec, slab: Slab, tabletop: TableTexture, assets: dict[str, bytes]) -> None:
    material = _add_textured_material(spec, TABLE, tabletop.texture_png, assets)
    material.specular, material.shininess = 0.15, 0.3
    material.texrepeat = 2 * slab.half_size_xy / tabletop.tile_m
    top = spec.geom(TABLE)
    top.material, top.rgba = TABLE, [tabletop.tint] * 3 + [1.0]


def _add_backdrop(spec: mujoco.MjSpec, backdrop: Backdrop, assets: dict[str, bytes]) -> None:
    material = _add_textured_material(spec, BACKDROP, backdrop.texture_png, assets)
    material.specular = 0.0
    body = spec.worldbody.add_body(name=BACKDROP, pos=backdrop.center)
    body.quat = multiply_quaternions(backdrop.quaternion_wxyz, OPENCV_TO_OPENGL)
    sheet = body.add_geom(spec.find_default("visual"), name=BACKDROP, type=mujoco.mjtGeom.mjGEOM_PLANE)
    sheet.size, sheet.material = [*backdrop.half_size_xy, 1.0], BACKDROP
    sheet.rgba = [backdrop.tint] * 3 + [1.0]


def _add_textured_material(
    spec: mujoco.MjSpec, name: str, texture_png: bytes, assets: dict[str, bytes]
) -> mujoco.MjsMaterial:
    assets[f"{ASSETS}/{name}.png"] = texture_png
    spec.add_texture(name=name, type=mujoco.mjtTexture.mjTEXTURE_2D, file=f"{name}.png")
    material = spec.add_material(name=name)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
    return material


def _add_camera(spec: mujoco.MjSpec, view: PosedCamera) -> None:
    camera, pose = view.camera, view.camera_to_table
    eye = spec.worldbody.add_camera(name="observation")
    eye.pos, eye.quat = pose.position, multiply_quaternions(pose.quaternion_wxyz, OPENCV_TO_OPENGL)
    eye.resolution = [camera.width, camera.height]
    eye.sensor_size = [camera.width * _PIXEL_M, camera.height * _PIXEL_M]
    eye.focal_pixel = [camera.fx, camera.fy]
    eye.principal_pixel = [(camera.width - 1) / 2 - camera.cx, (camera.height - 1) / 2 - camera.cy]


def _add_body(spec: mujoco.MjSpec, body: SceneBody, assets: dict[str, bytes]) -> mujoco.MjsBody:
    part = spec.worldbody.add_body(name=body.object_id)
    part.pos, part.quat = body.pose.position, body.pose.quaternion_wxyz
    part.add_freejoint(name=body.object_id)
    inertia = body.properties.inertia
    part.mass, part.ipos = body.properties.mass_kg, body.properties.center
    part.fullinertia = [inertia[0, 0], inertia[1, 1], inertia[2, 2], inertia[0, 1], inertia[0, 2], inertia[1, 2]]
    part.explicitinertial = True
    for index, hull in enumerate(body.hulls):
        name = f"{make_file_stem(body.object_id)}_piece_{index:02d}"
        geom = _add_mesh_geom(spec, part, name, "collision", encode_piece(hull), assets, solid=True)
        geom.friction = [body.friction, TORSIONAL_FRICTION, body.rolling_friction]
    return part


def _add_visual(spec: mujoco.MjSpec, part: mujoco.MjsBody, body: SceneBody, assets: dict[str, bytes]) -> None:
    name = make_file_stem(body.object_id)
    solid = encloses_volume(body.mesh)
    data = encode_visual(body.mesh, body.appearance)
    geom = _add_mesh_geom(spec, part, name, "visual", data, assets, solid)
    if body.appearance is None:
        geom.rgba = [*(np.array(body.color) / 255.0), 1.0]
        return
    material = _add_textured_material(spec, name, body.appearance.texture_png, assets)
    material.specular, material.shininess = 0.2, 0.3
    geom.material = name


def _add_mesh_geom(
    spec: mujoco.MjSpec, part: mujoco.MjsBody, name: str, kind: str, data: bytes, assets: dict[str, bytes], solid: bool
) -> mujoco.MjsGeom:
    assets[f"{ASSETS}/{name}.obj"] = data
    mesh = spec.add_mesh(name=name, file=f"{name}.obj")
    if not solid:  # the body has explicit inertia; `shell`, which MuJoCo 3.2 does not know, lets sheets compile
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    return part.add_geom(spec.find_default(kind), name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name)
