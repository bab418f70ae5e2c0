import os
import sys

# MuJoCo reads this when it is imported, by whoever is first; without a display only EGL can draw on Linux.
if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
    os.environ.setdefault("MUJOCO_GL", "egl")
