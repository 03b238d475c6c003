"""Ray casting with Open3D. The only module that imports it, when the first rays are cast."""

import ctypes
import functools
from dataclasses import dataclass
from types import ModuleType

import numpy as np
from jaxtyping import Float, Float32

from lidarlearn.simulation.meshes import Mesh


@dataclass(frozen=True)
class Hits:
    """What rays met first.

    Args:
        distances: along each ray, in units of its direction's length; infinite where it met nothing.
        normals: unit normal of the surface that was met, of either sign; zero where it met nothing.
    """

    distances: Float[np.ndarray, "n"]
    normals: Float[np.ndarray, "n 3"]


class RayCaster:
    """Casts rays against a mesh that does not change.

    Args:
        mesh: the surfaces.
    """

    def __init__(self, mesh: Mesh) -> None:
        open3d = _open3d()
        self._tensor = open3d.core.Tensor
        self._scene = open3d.t.geometry.RaycastingScene()
        vertices = np.ascontiguousarray(mesh.vertices, dtype=np.float32)
        triangles = np.ascontiguousarray(mesh.triangles, dtype=np.uint32)
        self._scene.add_triangles(self._tensor(vertices), self._tensor(triangles))

    def cast(self, rays: Float32[np.ndarray, "n 6"]) -> Hits:
        """The first surface on each ray, given as origin and direction."""
        answer = self._scene.cast_rays(self._tensor.from_numpy(rays))
        return Hits(answer["t_hit"].numpy(), answer["primitive_normals"].numpy())


@functools.cache
def _open3d() -> ModuleType:
    """Import Open3D. It links to the system's libusb-1.0, which a bare machine lacks: a wheel carries it instead."""
    try:
        import libusb_package

        ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
    except (ImportError, OSError):
        pass  # the system's own libusb may do
    import open3d

    return open3d
