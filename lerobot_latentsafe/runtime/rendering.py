"""Drawing MuJoCo's scenes by software OpenGL."""

import os

import mujoco


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
