"""Ray casting with Open3D, which only this module imports, and only when needed."""

import ctypes
import functools
from dataclasses import dataclass
from types import ModuleType

import numpy as np
from jaxtyping import Float, Float32

from lidarlearn.simulation.meshes import Mesh


@dataclass(frozen=True)
class Hits:
    """The first surfaces that rays hit.

    Args:
        distances: distance along each ray, in units of the length of its direction; infinite if it hits nothing.
        normals: unit normal of the surface, of either sign; zero if the ray hits nothing.
    """

    distances: Float[np.ndarray, "*batch"]
    normals: Float[np.ndarray, "*batch 3"]


class RayCaster:
    """Casts rays against a fixed mesh.

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

    def cast(self, rays: Float32[np.ndarray, "*batch 6"]) -> Hits:
        """Find the first surface on each ray, which is given by its origin and direction; `rays` is contiguous."""
        answer = self._scene.cast_rays(self._tensor.from_numpy(rays))
        return Hits(answer["t_hit"].numpy(), answer["primitive_normals"].numpy())


@functools.cache
def _open3d() -> ModuleType:
    """Import Open3D, which links to libusb-1.0. Systems without this library get it from a wheel."""
    try:
        import libusb_package

        ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
    except (ImportError, OSError):
        pass  # the system may have a libusb
    import open3d

    return open3d
