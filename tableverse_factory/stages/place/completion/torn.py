"""Torn shapes: what errors of a sensor's depth make of a free shape, and when a plain one must not take its place."""

from scipy import ndimage

from schemas.geometry import Pose, TriangleMesh
from tableverse_factory.geometry.mesh.meshes import place_mesh
from tableverse_factory.geometry.mesh.raycasting import make_raycasting_scene, pack_pixel_rays
from tableverse_factory.geometry.mesh.voxel_solids import to_manifold
from tableverse_factory.stages.place.view.object_view import ObjectView

MOST_TUNNELS = 10  # through a free shape, for each hole that the camera sees through, and one more; torn have 11 to 41
MIN_FULL = 0.75  # volume of a half-turned solid over its hull's: of scans 0.76 and more, with flaps 0.56 to 0.73
# A plain shape may stand before others by so much [m], and by more for this share of its pixels: 0 to 0.004 of those
# that are right, 0.010 and more of lids on trays
HIDES_M, MOST_HIDDEN = 0.005, 0.006


def is_torn(view: ObjectView, method: str, mesh: TriangleMesh) -> bool:
    """Tell whether errors of a sensor's depth tore a free shape: it has many holes, or flaps far from the rest.

    Raises:
        GeometryError: if the mesh bounds no solid.
    """
    _, seen = ndimage.label(ndimage.binary_fill_holes(view.own) & view.past)
    if method == "carved/half_turn":
        return bool(not seen and measure_fullness(mesh) < MIN_FULL)
    return bool(to_manifold(mesh).genus() > MOST_TUNNELS * (1 + seen))


def measure_fullness(mesh: TriangleMesh) -> float:
    """Measure the share of its convex hull that a closed mesh fills: dents and flaps leave the rest.

    Raises:
        GeometryError: if the mesh bounds no solid.
    """
    solid = to_manifold(mesh)
    return float(solid.volume() / solid.hull().volume())


def hides_others(view: ObjectView, mesh: TriangleMesh, pose: Pose) -> bool:
    """Tell whether a placed shape stands before what the picture shows of others, as a lid on what a tray holds."""
    scene = make_raycasting_scene(place_mesh(mesh, pose))
    hit = scene.cast_rays(pack_pixel_rays(view.camera, view.camera_to_table), nthreads=1)["t_hit"].numpy()
    others = ~view.own & ~view.past & (view.depth > 0.0)
    return bool((others & (hit < view.depth - HIDES_M)).sum() > MOST_HIDDEN * view.own.sum())
