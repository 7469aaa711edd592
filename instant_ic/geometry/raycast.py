"""Ray casting against a triangle mesh with Embree."""

import threading

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.floating]


class RayCaster:
    """Embree scene of one mesh. ``cast`` and ``occluded`` release the GIL and may be called from several threads.

    Args:
        vertices: (V, 3) metres.
        faces: (F, 3) vertex indices.
    """

    def __init__(self, vertices: FloatArray, faces: npt.NDArray[np.integer]) -> None:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        triangles = np.ascontiguousarray(np.asarray(vertices, np.float32)[faces])
        if triangles.ndim != 3 or triangles.shape[1:] != (3, 3) or len(triangles) == 0:
            raise ValueError(f"a mesh of at least one triangle is needed (got triangles of shape {triangles.shape})")
        self._scene = EmbreeScene(robust=True)
        self._mesh = TriangleMesh(self._scene, triangles)
        # The first query commits the scene, and two threads must not do this at once.
        self._lock = threading.Lock()
        with self._lock:
            self.cast(np.zeros((1, 3), np.float32), np.asarray([[0.0, 0.0, 1.0]], np.float32))

    def cast(
        self, origins: FloatArray, directions: FloatArray
    ) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int32]]:
        """Return the first hit of each ray.

        Args:
            origins: (N, 3) metres, or (3,) for all rays.
            directions: (N, 3) unit vectors.

        Returns:
            range_m (N,) float32, inf where nothing is hit; face (N,) int32, -1 where nothing is hit.
        """
        directions = np.ascontiguousarray(directions, np.float32)
        origins = np.ascontiguousarray(np.broadcast_to(np.asarray(origins, np.float32), directions.shape))
        hit = self._scene.run(origins, directions, output=True)
        face = hit["primID"]
        range_m = hit["tfar"]
        range_m[face < 0] = np.inf
        return range_m, face

    def occluded(self, origins: FloatArray, directions: FloatArray, distance_m: FloatArray) -> npt.NDArray[np.bool_]:
        """Return whether anything lies within ``distance_m`` (N,) along each ray (N, 3)."""
        hit = self._scene.run(
            np.ascontiguousarray(origins, np.float32),
            np.ascontiguousarray(directions, np.float32),
            dists=np.ascontiguousarray(distance_m, np.float32),
            query="OCCLUDED",
        )
        return np.asarray(hit) >= 0
