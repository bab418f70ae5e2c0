"""An SO-101 of primitive shapes in MuJoCo, a table with an edge, a mark painted across it, and a cube to push there.

    targets (6,) -> position servos with the lag of hobby servos -> arm -> cube

Link lengths are about those of the SO-101; shapes and masses are our own. The cube falls once its centre passes the
edge, and no arm brings it back: a filter has to stop the push before.
"""

import mujoco
import numpy as np

from lerobot_latentsafe.runtime.rendering import Drawn
from lerobot_latentsafe.so101.actions import (
    EPISODE_SECONDS,
    FOREARM,
    FPS,
    HAND,
    HIGH,
    IMAGE_SIZE,
    JOINTS,
    LOW,
    NAMES,
    REST,
    SHOULDER,
    UPPER_ARM,
    check_image_size,
)

TASK = "push the cube to the mark"
TIMESTEP = 1 / 360
EDGE = 0.32
"""Where the table ends, m ahead of the arm."""
HALF_CUBE = 0.015
MARKS = (0.240, 0.295)
"""Between these the mark lies, m ahead of the arm."""
STARTS, AZIMUTHS = (0.205, 0.220), (-12.0, 12.0)
"""Between these the cube starts: m ahead of the arm, and degrees to its left."""
ON_MARK = 0.015
"""Distance of the cube's centre from the mark's up to which it is on it, m."""
STATE = ["cube_x", "cube_y", "cube_z", "mark_x", "tip_x", "tip_y", "tip_z", *NAMES]
"""What `truth()["state"]` holds: places in m, then the measured joints."""
OPENING = np.radians([-5.0, 90.0])
"""Of the jaw at 0 and at 100, radians."""


class PushScene(Drawn):
    """The arm, the cube and the mark.

    Attributes:
        fps, task, image_size, episode_seconds: as the other simulated scenes have them.
        seed: of the last reset.
        mark: where the mark lies, m ahead of the arm.
        targets: (6,), where the joints were last told to go.
    """

    fps, task, episode_seconds = FPS, TASK, EPISODE_SECONDS

    def __init__(self, image_size: int = IMAGE_SIZE):
        check_image_size(image_size)
        self.model = mujoco.MjModel.from_xml_string(_scene(image_size))
        self.data = mujoco.MjData(self.model)
        self.image_size = image_size
        self.joints = [self.model.joint(joint).qposadr[0] for joint in JOINTS]
        self.cube = self.model.body("cube").id
        self.tip = self.model.site("tip").id
        self.targets = REST.copy()
        self.mark, self.seed = 0.0, 0

    def reset(self, seed: int) -> None:
        """Put the arm to rest, and the cube and the mark where `seed` says."""
        self.seed = seed
        rng = np.random.default_rng(seed)
        mujoco.mj_resetData(self.model, self.data)
        self.mark = self.model.geom("mark").pos[0] = rng.uniform(*MARKS)
        ahead, azimuth = rng.uniform(*STARTS), np.radians(rng.uniform(*AZIMUTHS))
        turn = azimuth / 2  # about its height; the cube looks at the arm
        pose = [ahead, ahead * np.tan(azimuth), HALF_CUBE, np.cos(turn), 0, 0, np.sin(turn)]
        self.data.qpos[self.model.joint("cube").qposadr[0] :][:7] = pose
        self.targets = REST.copy()
        self.data.qpos[self.joints] = self.data.ctrl[:] = _radians(self.targets)
        mujoco.mj_forward(self.model, self.data)

    def step(self, targets: np.ndarray) -> None:
        """Advance one control step under targets (6,), which are clipped into the joints' limits."""
        self.targets = np.clip(targets, LOW, HIGH)
        self.data.ctrl[:] = _radians(self.targets)
        for _ in range(round(1 / FPS / TIMESTEP)):
            mujoco.mj_step(self.model, self.data)
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)

    def proprioception(self) -> np.ndarray:
        """Measured joints (6,) float32, in the units of the actions."""
        angles = self.data.qpos[self.joints]
        opening = np.interp(angles[5], OPENING, [0.0, 100.0])
        return np.append(np.degrees(angles[:5]), opening).astype(np.float32)

    def cube_position(self) -> np.ndarray:
        """Centre of the cube (3,), m: ahead of the arm, to its left, up from the table."""
        return self.data.xpos[self.cube].copy()

    def tip_position(self) -> np.ndarray:
        """Tip of the gripper (3,), m."""
        return self.data.site_xpos[self.tip].copy()

    def truth(self) -> dict[str, float | bool | np.ndarray]:
        """Privileged. `margin`: m to the edge; `severity`: share of the cube past it; `state`: see `STATE`."""
        cube = self.cube_position()
        failure = bool(cube[0] > EDGE or cube[2] < 0)
        on_mark = bool(abs(cube[0] - self.mark) < ON_MARK and not failure)
        return {
            "margin": float(EDGE - cube[0]),
            "failure": failure,
            "is_success": on_mark,
            "reward": float(on_mark),
            "severity": float(np.clip((cube[0] + HALF_CUBE - EDGE) / (2 * HALF_CUBE), 0, 1)),
            "state": np.array([*cube, self.mark, *self.tip_position(), *self.proprioception()], np.float32),
        }


def _radians(targets: np.ndarray) -> np.ndarray:
    return np.append(np.radians(targets[:5]), np.interp(targets[5], [0.0, 100.0], OPENING))


def _joint(i: int, axis: str, pos: str = "0 0 0") -> str:
    low, high = OPENING if i == 5 else np.radians([LOW[i], HIGH[i]])
    return f'<joint name="{JOINTS[i]}" axis="{axis}" pos="{pos}" range="{low} {high}"/>'


def _scene(size: int) -> str:
    servos = "".join(f'<position name="{j}" joint="{j}" kp="30" kv="2.1" forcerange="-4 4"/>' for j in JOINTS)
    return f"""<mujoco model="so101">
<compiler angle="radian" autolimits="true"/>
<option timestep="{TIMESTEP}" integrator="implicitfast" cone="elliptic" impratio="3"/>
<visual>
  <global offwidth="{size}" offheight="{size}"/>
  <headlight ambient="0.5 0.5 0.5" diffuse="0.3 0.3 0.3" specular="0 0 0"/>
  <quality shadowsize="0" offsamples="0" numslices="10" numstacks="5" numquads="1"/>
  <map znear="0.02" zfar="20"/>
</visual>
<default>
  <joint armature="0.01" damping="0.05"/>
  <geom density="600" contype="2" conaffinity="1" rgba="0.95 0.75 0.15 1" friction="0.6"/>
</default>
<asset><texture type="skybox" builtin="flat" rgb1="0.2 0.22 0.26" width="8" height="8"/></asset>
<worldbody>
  <light pos="0.3 -0.5 1.5" dir="0 0.3 -1" type="directional" diffuse="0.4 0.4 0.4" specular="0 0 0"/>
  <geom name="table" type="box" size="{(EDGE + 0.2) / 2} 0.3 0.02" pos="{EDGE / 2 - 0.1} 0 -0.02" contype="1"
    conaffinity="3" rgba="0.78 0.72 0.62 1"/>
  <geom name="floor" type="plane" size="1 1 0.1" pos="0 0 -0.25" contype="1" conaffinity="3" rgba="0.22 0.24 0.28 1"/>
  <geom name="mark" type="box" size="0.006 0.14 0.0005" pos="0.27 0 0" contype="0" conaffinity="0"
    rgba="0.1 0.55 0.25 1"/>
  <camera name="front" pos="0.52 0 0.30" xyaxes="0 1 0 -0.755 0 0.656" fovy="40"/>
  <body name="cube" pos="0 0 1">
    <freejoint name="cube"/>
    <geom type="box" size="{HALF_CUBE} {HALF_CUBE} {HALF_CUBE}" mass="0.04" contype="1" conaffinity="3"
      rgba="0.85 0.12 0.12 1" friction="0.45"/>
  </body>
  {_arm()}
</worldbody>
<actuator>{servos}</actuator>
</mujoco>"""


def _arm() -> str:
    bone = 'type="capsule" size="0.014"'
    return f"""
<geom type="cylinder" size="0.03 0.03" pos="0 0 0.03" rgba="0.15 0.15 0.16 1" contype="0" conaffinity="0"/>
<body name="shoulder" gravcomp="1">{_joint(0, "0 0 1")}
  <geom {bone} fromto="0 0 0.05 {SHOULDER[0]} 0 {SHOULDER[1]}"/>
  <body name="upper_arm" gravcomp="1" pos="{SHOULDER[0]} 0 {SHOULDER[1]}">{_joint(1, "0 1 0")}
    <geom {bone} fromto="0 0 0 0 0 {UPPER_ARM}"/>
    <body name="forearm" gravcomp="1" pos="0 0 {UPPER_ARM}">{_joint(2, "0 1 0")}
      <geom {bone} fromto="0 0 0 {FOREARM} 0 0"/>
      <body name="wrist" gravcomp="1" pos="{FOREARM} 0 0">{_joint(3, "0 1 0")}
        <geom {bone} fromto="0 0 0 0.05 0 0" rgba="0.15 0.15 0.16 1"/>
        <body name="gripper" gravcomp="1" pos="0.05 0 0">{_joint(4, "1 0 0")}
          <camera name="wrist" pos="0.0 0 0.06" xyaxes="0 -1 0 0.35 0 0.94" fovy="70"/>
          <geom type="box" size="0.02 0.018 0.012" pos="0.02 0 0"/>
          <geom type="box" size="0.035 0.009 0.008" pos="{HAND - 0.085} 0.009 0"/>
          <site name="tip" pos="{HAND - 0.05} 0 0"/>
          <body name="jaw" gravcomp="1" pos="0.04 -0.009 0">{_joint(5, "0 0 -1")}
            <geom type="box" size="0.035 0.009 0.008" pos="{HAND - 0.125} 0 0" rgba="0.15 0.15 0.16 1"/>
          </body>
        </body>
      </body>
    </body>
  </body>
</body>"""
