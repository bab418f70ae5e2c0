"""Drawing MuJoCo's scenes by software OpenGL."""

import os

import mujoco
import numpy as np


def make_renderer(model: mujoco.MjModel, size: int) -> mujoco.Renderer:
    """A renderer of square pictures.

    Raises:
        RuntimeError: there is no OpenGL library to draw with.
    """
    # Software OpenGL is fastest drawing in the calling thread, and leaves the other cores to other processes.
    os.environ.setdefault("LP_NUM_THREADS", "0")
    try:
        return mujoco.Renderer(model, size, size, max_geom=400)
    except Exception as e:
        raise RuntimeError(
            f"MuJoCo cannot make an OpenGL context with MUJOCO_GL={os.environ.get('MUJOCO_GL', '')!r} ({e}). "
            "Without a display use MUJOCO_GL=egl with libegl1 and libgl1-mesa-dri (Debian: apt-get install libegl1 "
            "libgl1-mesa-dri), or MUJOCO_GL=osmesa with libosmesa6; set it in the shell if another package imports "
            "MuJoCo first"
        ) from e


class Drawn:
    """A scene that can be drawn: it has `model`, `data` and `image_size`."""

    model: mujoco.MjModel
    data: mujoco.MjData
    image_size: int
    _renderer: mujoco.Renderer | None = None

    def render(self, camera: str) -> np.ndarray:
        """A picture (size, size, 3) uint8.

        Raises:
            RuntimeError: there is no OpenGL library to draw with.
        """
        if self._renderer is None:
            self._renderer = make_renderer(self.model, self.image_size)
        self._renderer.update_scene(self.data, camera)
        return self._renderer.render()

    def location(self) -> dict[str, float]:
        """What policies may be told that are not to look, number by number; most scenes tell nothing."""
        return {}

    def close(self) -> None:
        """Free the OpenGL context."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
