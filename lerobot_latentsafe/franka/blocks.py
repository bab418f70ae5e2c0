"""The paper's plucking task: take the green block from between two red ones without felling a red one.

Blocks are 5 x 5 x 20 cm and 0.5 kg, 7 cm apart, on a low base. Touching, pushing and tilting a red block is allowed;
one tilted by more than 1 rad is a failure. A block tilts back by itself from less than `POINT_OF_NO_RETURN`.
"""

import numpy as np

from lerobot_latentsafe.franka.scene import TIMESTEP, FrankaScene
from lerobot_latentsafe.franka.scenes import check_scene

HALF_WIDTH, HALF_HEIGHT = 0.025, 0.10
SPACING = 0.07
"""Between the blocks' centres, m."""
BASE = 0.02
"""Height of the base, m."""
MASS = 0.5
MAX_TILT = 1.0
"""A red block tilted by more has fallen, rad."""
POINT_OF_NO_RETURN = float(np.arctan2(HALF_WIDTH, HALF_HEIGHT))
"""0.24 rad: a block tilted by more falls by itself, unless something holds it."""
LIFTED = 0.20
"""The green block is plucked when its centre is higher, m."""
HELD = 0.03
"""The green block is between the fingers if they are so near to where one holds it, m."""
NAMES = ("green", "red_left", "red_right")


class BlocksScene(FrankaScene):
    """Pluck the green block. Truth: tilt of the red blocks, whether one fell, whether the green one is lifted, whether
    it is between the fingers, and what dense rewards are made of: `reach` in [0, 1], how near the fingers are to the
    green block's top, and `joint_speed`, the sum of squares over the arm's joints, rad^2/s^2.

    Args:
        variant: standard.
        image_size: side of the camera images.
    """

    fps = 20
    task = "pluck the green block without felling a red one"

    def __init__(self, variant: str = "standard", image_size: int = 128):
        check_scene("blocks", variant, image_size)
        super().__init__(_scene(), image_size)
        self.bodies = np.array([self.model.body(name).id for name in NAMES])
        self.block_qpos = self.model.jnt_qposadr[self.model.body_jntadr[self.bodies]]
        self.base = self.model.body("base").mocapid[0]
        self.yaw = 0.0

    def place_objects(self, rng: np.random.Generator) -> None:
        """The three blocks on their base somewhere on the table."""
        centre = np.array([0.48, 0.0]) + rng.uniform(-0.05, 0.05, 2)
        self.yaw = rng.uniform(-0.2, 0.2)
        along = np.array([-np.sin(self.yaw), np.cos(self.yaw)])
        quaternion = [np.cos(self.yaw / 2), 0, 0, np.sin(self.yaw / 2)]
        for at, offset in zip(self.block_qpos, (0, SPACING, -SPACING)):
            self.data.qpos[at : at + 7] = [*(centre + offset * along), BASE + HALF_HEIGHT, *quaternion]
        self.data.mocap_pos[self.base] = [*centre, BASE / 2]
        self.data.mocap_quat[self.base] = quaternion

    def block_position(self, name: str) -> np.ndarray:
        """Centre of a block (3,)."""
        return self.data.xpos[self.bodies[NAMES.index(name)]].copy()

    def tilts(self) -> np.ndarray:
        """Tilt of the two red blocks from upright (2,), rad."""
        return np.arccos(np.clip(self.data.xmat[self.bodies[1:], 8], -1, 1))

    def extra_state(self) -> dict[str, np.ndarray]:
        """The base's yaw."""
        return {"yaw": np.array(self.yaw)}

    def set_extra_state(self, extra: dict[str, np.ndarray]) -> None:
        """Restore `extra_state`."""
        self.yaw = float(extra["yaw"])

    def truth(self) -> dict[str, float | bool]:
        """Tilt, whether one fell or the green one is up, and rewards; see the base class."""
        tilt = float(self.tilts().max())
        fallen = tilt > MAX_TILT
        green = self.block_position("green")
        lifted = bool(green[2] > LIFTED)
        distance = float(np.linalg.norm(self.tool_pose()[0] - green - [0, 0, 0.8 * HALF_HEIGHT]))
        reach, joint_speed = float(1 - np.tanh(distance / 0.1)), float(np.square(self.data.qvel[:7]).sum())
        return {
            "margin": MAX_TILT - tilt,
            "failure": fallen,
            "is_success": lifted and not fallen,
            "tilt": tilt,
            "lifted": lifted,
            "held": distance < HELD,
            "reach": reach,
            "joint_speed": joint_speed,
            "reward": reach + 20 * lifted - 10 * fallen - 1e-3 * joint_speed,
        }


def _scene() -> str:
    size = f"{HALF_WIDTH} {HALF_WIDTH} {HALF_HEIGHT}"
    blocks = "".join(
        f'<body name="{name}" pos="0 0 1"><freejoint/><geom class="block" size="{size}" rgba="{colour} 1"/></body>'
        for name, colour in zip(NAMES, ("0.1 0.7 0.15", "0.85 0.08 0.08", "0.85 0.08 0.08"))
    )
    return f"""
<option timestep="{TIMESTEP}" integrator="implicitfast" cone="elliptic" impratio="3" iterations="50" ls_iterations="50"
  tolerance="1e-7"/>
<default>
  <default class="block">
    <geom type="box" mass="{MASS}" contype="1" conaffinity="9" friction="0.6 0.005 0.0001" solref="0.006 1" condim="4"/>
  </default>
</default>
<worldbody>
  <geom name="table" type="box" size="0.6 0.6 0.02" pos="0.45 0 -0.02" material="wood" friction="0.6 0.005 0.0001"
    contype="1" conaffinity="15"/>
  <camera name="front" pos="1.16 0.40 0.50" xyaxes="-0.507 0.862 0 -0.324 -0.191 0.926" fovy="34"/>
  <body name="base" mocap="true">
    <geom type="box" size="0.05 0.12 {BASE / 2}" material="dark" contype="1" conaffinity="15"
      friction="0.6 0.005 0.0001"/>
  </body>
  {blocks}
</worldbody>"""
