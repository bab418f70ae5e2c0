"""A Franka Research 3 in MuJoCo: control, cameras and exact state, shared by the scenes of `bag.py` and `blocks.py`.

    action (7,) -> commanded pose -> inverse kinematics (mink) -> joint target, limited in speed
                -> interpolated over the control step -> position actuators

A scene is used through a LeRobot robot (`robots/franka_mujoco`) and through gymnasium (`franka_env.py`).
"""

import copy
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import mink
import mujoco
import numpy as np

from lerobot_latentsafe.franka.actions import (
    GRIPPER_SPEED,
    GRIPPER_WIDTH,
    HOME,
    JOINT_SPEED,
    POINTING_DOWN,
    WORKSPACE_HIGH,
    WORKSPACE_LOW,
    action_limits,
)
from lerobot_latentsafe.runtime.rendering import Drawn

ASSETS = Path(__file__).parent / "assets"
CAMERAS = ("front", "wrist")
TIMESTEP = 1 / 600
REACH_TOLERANCE = 0.005
"""Distance of the inverse kinematics' solution beyond which a pose counts as out of reach, m."""
MAX_ACCELERATION = 1e4
"""Beyond this a solution of the contact forces is not believed, rad/s^2 or m/s^2; the light film has reached 5e3."""
PHYSICS = mujoco.mjtState.mjSTATE_INTEGRATION

VISUAL = """<visual>
  <global offwidth="{size}" offheight="{size}"/>
  <quality shadowsize="0" offsamples="0" numslices="10" numstacks="5" numquads="1"/>
</visual>"""
"""Shadows and multisampling are most of the cost of software OpenGL; coarse spheres and planes most of the rest."""


def compile_scene(content: str, image_size: int) -> mujoco.MjModel:
    """The arm with a scene's MJCF elements around it."""
    xml = f'<mujoco><include file="franka.xml"/>{VISUAL.format(size=image_size)}{content}</mujoco>'
    return mujoco.MjModel.from_xml_string(xml, {"franka.xml": (ASSETS / "franka.xml").read_bytes()})


class InverseKinematics:
    """Joint angles for a pose of the tool, by mink, near the present ones and within joint limits."""

    def __init__(self, iterations: int = 3):
        self.iterations = iterations
        model = mujoco.MjModel.from_xml_path(str(ASSETS / "franka.xml"))
        self.configuration = mink.Configuration(model)
        self.tool = mink.FrameTask("tcp", "site", position_cost=1.0, orientation_cost=0.3, lm_damping=1e-4)
        self.posture = mink.PostureTask(model, cost=1e-3)
        self.posture.set_target(np.concatenate([HOME, np.zeros(model.nq - 7)]))
        self.limits = [mink.ConfigurationLimit(model)]
        self.rest = np.zeros(model.nq - 7)

    def solve(self, joints: np.ndarray, position: np.ndarray, rotation: np.ndarray) -> np.ndarray:
        """(7,) start, (3,), (3, 3) -> (7,)."""
        self.configuration.update(np.concatenate([joints, self.rest]))
        self.tool.set_target(mink.SE3.from_rotation_and_translation(mink.SO3.from_matrix(rotation), position))
        for _ in range(self.iterations):
            speed = mink.solve_ik(
                self.configuration, [self.tool, self.posture], 1.0, "daqp", damping=1e-6, limits=self.limits
            )
            self.configuration.integrate_inplace(speed, 1.0)
        return self.configuration.q[:7].copy()

    def pose(self, joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Forward kinematics: (7,) -> position (3,), rotation (3, 3)."""
        self.configuration.update(np.concatenate([joints, self.rest]))
        pose = self.configuration.get_transform_frame_to_world("tcp", "site")
        return pose.translation().copy(), pose.rotation().as_matrix()


@dataclass
class Controller:
    """What the controller remembers between steps."""

    joints: np.ndarray
    """Commanded joint angles (7,)."""
    position: np.ndarray
    """Commanded tool centre (3,)."""
    rotation: np.ndarray
    """Commanded tool orientation (3, 3)."""
    finger: float
    """Commanded travel of each finger, m."""


@dataclass
class SceneState:
    """Everything a scene's future depends on; stepping on from it is exact."""

    physics: np.ndarray
    controller: Controller
    extra: dict[str, np.ndarray]


class FrankaScene(Drawn):
    """A table-top scene around the arm. Subclasses add objects, their reset, and the privileged truth.

    Attributes:
        fps: control steps a second; TIMESTEP divides it.
        task: what the robot should do, in words.
        seed: of the last reset.
    """

    fps: int
    task: str

    def __init__(self, content: str, image_size: int):
        self.model = compile_scene(content, image_size)
        self.data = mujoco.MjData(self.model)
        self.image_size = image_size
        self.substeps = round(1 / self.fps / TIMESTEP)
        self.kinematics = InverseKinematics()
        self.tool = self.model.site("tcp").id
        self.fingers = [self.model.joint(f"finger_{side}").qposadr[0] for side in ("left", "right")]
        self._before = np.empty(mujoco.mj_stateSize(self.model, PHYSICS))
        self.controller = self._home()
        self.seed = 0

    def _home(self) -> Controller:
        position, rotation = self.kinematics.pose(HOME)
        return Controller(HOME.copy(), position, rotation, GRIPPER_WIDTH / 2)

    def reset(self, seed: int) -> None:
        """Put the arm at home and the objects where `seed` says."""
        self.seed = seed
        mujoco.mj_resetData(self.model, self.data)
        self.controller = self._home()
        self.data.qpos[:7] = self.data.ctrl[:7] = HOME
        self.data.qpos[self.fingers] = self.data.ctrl[7:9] = self.controller.finger
        self.place_objects(np.random.default_rng(seed))
        self._refresh()

    def place_objects(self, rng: np.random.Generator) -> None:
        """Set the objects' positions; velocities are zero."""
        raise NotImplementedError

    def step(self, action: np.ndarray) -> None:
        """Advance one control step. action: (7,), see `franka/actions.py`; clipped into its limits.

        A motion to a pose the arm cannot reach is not begun: the arm stays, only the fingers move.
        """
        action = np.clip(action, *action_limits(self.fps))
        control = self.controller
        position = np.clip(control.position + action[:3], WORKSPACE_LOW, WORKSPACE_HIGH)
        rotation = mink.SO3.exp(action[3:6]).as_matrix() @ control.rotation
        joints = self.kinematics.solve(control.joints, position, rotation)
        reached, _ = self.kinematics.pose(joints)
        if np.linalg.norm(reached - position) < REACH_TOLERANCE:
            control.position, control.rotation = position, rotation
        else:
            joints = control.joints
        self._drive(joints, action[6])

    def move_joints(self, joints: np.ndarray, gripper: float) -> None:
        """Advance one control step towards joint angles (7,); the commanded pose follows."""
        self._drive(joints, gripper)
        self.controller.position, self.controller.rotation = self.kinematics.pose(self.controller.joints)

    def _drive(self, joints: np.ndarray, gripper: float) -> None:
        control, data = self.controller, self.data
        reach = JOINT_SPEED / self.fps
        start, end = control.joints, np.clip(joints, control.joints - reach, control.joints + reach)
        travel = GRIPPER_SPEED / 2 / self.fps
        finger = np.clip(gripper * GRIPPER_WIDTH / 2, control.finger - travel, control.finger + travel)
        for i in range(1, self.substeps + 1):
            share = i / self.substeps
            data.ctrl[:7] = start + (end - start) * share
            self.set_fingers(control.finger + (finger - control.finger) * share, i)
            self._advance()
        control.joints, control.finger = end, float(finger)
        self._refresh()

    def _advance(self) -> None:
        """One time step.

        Newton's method is fast, but once in some hundred thousand steps it returns contact forces that throw the bag
        across the room. Such a step is repeated by conjugate gradients, which then find ordinary ones.
        """
        model, data = self.model, self.data
        mujoco.mj_getState(model, data, self._before, PHYSICS)
        velocity = data.qvel.copy()
        mujoco.mj_step(model, data)
        # Not data.qacc, which then looks as if nothing had happened.
        if not np.abs(data.qvel - velocity).max() < MAX_ACCELERATION * TIMESTEP:
            mujoco.mj_setState(model, data, self._before, PHYSICS)
            newton, model.opt.solver = model.opt.solver, mujoco.mjtSolver.mjSOL_CG
            mujoco.mj_step(model, data)
            model.opt.solver = newton

    def set_fingers(self, travel: float, substep: int) -> None:
        """Command both fingers, m from closed; scenes in which the grasp is modelled add to it."""
        # Commanded a little beyond closed, so that a grasped object is pressed.
        self.data.ctrl[7:9] = travel if travel > 1e-4 else -0.01

    def _refresh(self) -> None:
        """Positions of bodies, sites and cameras that belong to qpos, without touching the solver's warm start."""
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)

    def tool_pose(self) -> tuple[np.ndarray, np.ndarray]:
        """Measured tool centre (3,) and rotation (3, 3)."""
        return self.data.site_xpos[self.tool].copy(), self.data.site_xmat[self.tool].reshape(3, 3).copy()

    def proprioception(self) -> np.ndarray:
        """(14,) float32 in the order of STATE_NAMES."""
        position, rotation = self.tool_pose()
        turned = mink.SO3.from_matrix(rotation @ POINTING_DOWN.T).log()
        opening = np.clip(self.data.qpos[self.fingers].sum() / GRIPPER_WIDTH, 0, 1)
        return np.concatenate([self.data.qpos[:7], [opening], position, turned]).astype(np.float32)

    def exploded(self) -> bool:
        """Whether MuJoCo warned of bad numbers, or something moves faster than anything physical (30 m/s, rad/s)."""
        bad = (mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC)
        warned = any(self.data.warning[int(w)].number for w in bad)
        return bool(warned or not np.abs(self.data.qvel).max() < 30)

    def get_state(self) -> SceneState:
        """A copy of the state, to branch from."""
        physics = np.empty(mujoco.mj_stateSize(self.model, PHYSICS))
        mujoco.mj_getState(self.model, self.data, physics, PHYSICS)
        return SceneState(physics, _copy(self.controller), self.extra_state())

    def set_state(self, state: SceneState) -> None:
        """Return to a state of `get_state`."""
        mujoco.mj_setState(self.model, self.data, state.physics, PHYSICS)
        self.controller = _copy(state.controller)
        self.set_extra_state(state.extra)
        self._refresh()

    def extra_state(self) -> dict[str, np.ndarray]:
        """What a scene keeps outside MuJoCo's state."""
        return {}

    def set_extra_state(self, extra: dict[str, np.ndarray]) -> None:
        """Restore `extra_state`."""

    def truth(self) -> dict[str, float | bool]:
        """Privileged: at least `margin` (< 0: failure), `failure`, `is_success`. Never an input of a policy.

        Where one failure is worse than another, `severity` says how bad it is now, from 0 to 1.
        """
        raise NotImplementedError


def _copy(controller: Controller) -> Controller:
    values: dict[str, Any] = {f.name: copy.copy(getattr(controller, f.name)) for f in fields(controller)}
    return Controller(**values)
