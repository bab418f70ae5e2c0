"""An open bag of candies that spill.

The bag is a chain of segments along x, hinged to each other like a folded film: a sealed tail, which holds nothing,
and a pouch that ends in an open mouth. Each segment has a floor, a roof, and two side walls that slide inwards. One
skin is drawn over all. Candies are spheres that slide but do not roll, as flat candies do.

What is simulated and what is modelled: the candies, the film and the table touch each other by MuJoCo's contacts, and
nothing about the spill is scripted. The *grasp* is modelled: while the fingers close around a segment they push its
side walls in, and once they hold it a soft weld joins it to the hand until they open. Contacts alone do not hold thin
walls reliably. Fingers pass through the bag until they close on it, and through candies.
"""

from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np

from lerobot_latentsafe.franka.actions import GRIPPER_WIDTH, POINTING_DOWN
from lerobot_latentsafe.franka.scene import TIMESTEP, FrankaScene
from lerobot_latentsafe.franka.scenes import check_scene

SEGMENTS = 7
"""0 is the tail, the last is the mouth."""
LENGTH = 0.026
"""Of a segment along the bag, m; the bag is SEGMENTS times as long."""
WIDTH, HEIGHT = 0.056, 0.030
"""Inside of the pouch, m."""
FILM = 0.003
"""Half the thickness of floor and roof, m."""
WALL = 0.004
"""Half the thickness of a side wall, m."""
THICK = 0.006
"""Half the thickness of plates where they may reach outwards: candies do not pass through a thick plate, m."""
LIP = 0.004
"""Height of the mouth's rim, m."""
HALF_OUTSIDE = WIDTH / 2 + 2 * WALL
SPILL_MARGIN = 0.004
"""A candy counts as spilled when its centre is this far outside the pouch, m."""
CANDY_COLOURS = ("0.8 0.1 0.1", "0.95 0.5 0.05", "0.95 0.85 0.1", "0.15 0.6 0.15", "0.4 0.1 0.5")
TAIL, MIDDLE, MOUTH = 0, 3, SEGMENTS - 1
WAYS = [f"{part}_{axis}" for part in ("closed_end", "middle") for axis in "xyz"] + ["bag_yaw"]
LOCATION_NAMES = [*WAYS, *(f"{name}_near" for name in WAYS)]
"""Of `BagScene.location`."""
NEAR = np.array([0.02] * 6 + [0.2])
"""Ways (m) and turn (rad) up to which a policy is told in detail: 20 mm beside is of no use."""


@dataclass(frozen=True)
class Variant:
    """Looks and mechanics of a bag: bending stiffness in N m/rad, mass in kg, radius in m.

    Friction is that of film and candies; `beside` holds further MJCF elements of the scene.
    """

    colour: str = "0.78 0.05 0.06"
    cloth: bool = False
    stiffness: float = 0.03
    candy_mass: float = 0.002
    candy_radius: float = 0.0065
    sealed: bool = False
    friction: float = 0.3
    beside: str = ""


VARIANTS: dict[str, Variant] = {
    "red": Variant(),
    "green": Variant(colour="0.15 0.62 0.12"),
    "purple": Variant(colour="0.42 0.12 0.55"),
    "cloth": Variant(cloth=True),
    "stiff": Variant(colour="0.33 0.18 0.10", stiffness=0.12),
    "heavy": Variant(colour="0.90 0.72 0.10", stiffness=0.12, candy_mass=0.0045, candy_radius=0.0075),
    "sealed": Variant(sealed=True),
}


def varied(rng: np.random.Generator) -> Variant:
    """A bag that looks like the red one, and is stiffer or softer, heavier or lighter, rougher or smoother.

    The ranges leave out `stiff`, `heavy` and bags beyond them, on which filters are tested.
    """
    stiffness, candy_mass, friction = np.exp(rng.uniform(*np.log([(0.012, 0.0012, 0.12), (0.08, 0.0035, 0.5)])))
    return Variant(stiffness=stiffness, candy_mass=candy_mass, friction=friction)


class Segment(NamedTuple):
    """Ids of a segment's parts in the compiled model."""

    body: int
    walls: np.ndarray
    """Joints of its two side walls."""
    weld: int


class BagScene(FrankaScene):
    """Lift the bag without spilling. Truth: spilled candies, spill fraction, success.

    Args:
        variant: one of VARIANTS, or another.
        n_candies: how many candies, 20 to 40.
        image_size: side of the camera images.
    """

    fps = 15
    task = "lift the bag without spilling candy"
    lift_height = 0.10
    """The bag counts as lifted when the held segment is this far above where it lay, m."""

    def __init__(self, variant: str | Variant = "red", n_candies: int = 24, image_size: int = 224):
        check_scene("bag", variant if isinstance(variant, str) else None, image_size)
        if not 20 <= n_candies <= 40:
            raise ValueError(f"n_candies is {n_candies}; expected 20 to 40")
        self.variant = VARIANTS[variant] if isinstance(variant, str) else variant
        self.n_candies = n_candies
        super().__init__(_scene(self.variant, n_candies), image_size)
        model = self.model
        self.segments = [
            Segment(
                model.body(f"segment_{k}").id,
                np.array([model.joint(f"wall_{side}_{k}").id for side in ("left", "right")]),
                model.equality(f"grasp_{k}").id,
            )
            for k in range(SEGMENTS)
        ]
        self.bodies = np.array([s.body for s in self.segments])
        self.candies = np.array([model.body(f"candy_{i}").id for i in range(n_candies)])
        self.candy_qpos = model.jnt_qposadr[model.body_jntadr[self.candies]][:, None] + np.arange(3)
        self.candy_origin = model.body_pos[self.candies].copy()
        self.bag_qpos = model.jnt_qposadr[model.joint("bag").id]
        self.wall_qpos = np.array([model.jnt_qposadr[s.walls] for s in self.segments])
        self.wall_dof = np.array([model.jnt_dofadr[s.walls] for s in self.segments])
        self.hand = model.body("hand").id
        self._settled: dict[int, np.ndarray] = {}

    # Reset

    n_settled = 8
    """Different heaps of candies; each is dropped and settled once, then moved about with the bag."""

    def place_objects(self, rng: np.random.Generator) -> None:
        """Bag and candies somewhere on the table, turned anyhow."""
        heap = int(rng.integers(self.n_settled))
        centre = np.array([0.50, 0.0]) + rng.uniform(-0.11, 0.11, 2)
        yaw = rng.uniform(-np.pi, np.pi)
        self.data.qpos[9:] = self._settle(heap)[9:]
        self._move_bag(centre, yaw)
        self.data.eq_active[:] = 0

    def _settle(self, heap: int) -> np.ndarray:
        """qpos of the bag along x around the origin with settled candies."""
        if heap not in self._settled:
            # In data of its own: what was simulated before must not change the last bit of it.
            data, rng = mujoco.MjData(self.model), np.random.default_rng([heap, 7])
            data.qpos[:9], data.ctrl[:9] = self.data.qpos[:9], self.data.ctrl[:9]
            data.qpos[self.bag_qpos : self.bag_qpos + 7] = [_x(0), 0, _z(), 1, 0, 0, 0]
            data.qpos[self.candy_qpos] = _heap(self.n_candies, self.variant.candy_radius, rng) - self.candy_origin
            for _ in range(round(0.8 / TIMESTEP)):
                mujoco.mj_step(self.model, data)
            self._settled[heap] = data.qpos.copy()
        return self._settled[heap]

    def _move_bag(self, centre: np.ndarray, yaw: float) -> None:
        """Turn and shift bag and candies, which lie around the origin."""
        qpos, turn = self.data.qpos, np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        bag = qpos[self.bag_qpos : self.bag_qpos + 7]
        bag[:2] = turn @ bag[:2] + centre
        quaternion = np.array([np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)])
        mujoco.mju_mulQuat(bag[3:7], quaternion, bag[3:7].copy())
        candies = qpos[self.candy_qpos] + self.candy_origin
        candies[:, :2] = candies[:, :2] @ turn.T + centre
        qpos[self.candy_qpos] = candies - self.candy_origin
        self.yaw = yaw

    # The modelled grasp

    def set_fingers(self, travel: float, substep: int) -> None:
        """Command the fingers, and model the grasp."""
        if substep % 8 == 1:
            self._grasp(travel)
        self.data.ctrl[7:9] = np.maximum(travel, self.stop)

    stop = 0.0
    """Finger travel at which the walls of the segment between the fingers stop them, m."""

    def _grasp(self, travel: float) -> None:
        """Push in the walls between the fingers, and weld a held segment to the hand until the fingers open."""
        data = self.data
        rotation = data.xmat[self.hand].reshape(3, 3)
        local = (data.xpos[self.bodies] - data.site_xpos[self.tool]) @ rotation
        between = (np.abs(local) < [0.022, 0.02, 0.035]).all(1)
        opening = data.qpos[self.fingers].sum() / 2
        squeeze = max(0.0, HALF_OUTSIDE - opening)
        self.stop = 0.0
        for k in range(SEGMENTS):
            inwards = data.qpos[self.wall_qpos[k]]
            force = WALL_GAIN * (squeeze - inwards) if between[k] and squeeze > 0 else np.zeros(2)
            data.qfrc_applied[self.wall_dof[k]] = np.clip(force, 0, WALL_FORCE)
            if between[k]:
                self.stop = max(self.stop, HALF_OUTSIDE - inwards.min() - 0.004)
        held, nearest = self.held_segment(), int(np.abs(local[:, 0]).argmin())
        if held is not None and travel > 0.032:
            data.eq_active[self.segments[held].weld] = 0
        elif held is None and between[nearest] and squeeze > 0.010 and travel < 0.03:
            self._weld(self.segments[nearest], rotation)

    def _weld(self, segment: Segment, rotation: np.ndarray) -> None:
        """Join a segment to the hand in their present relative pose."""
        model, data = self.model, self.data
        hand, relative = np.empty(4), np.empty(4)
        mujoco.mju_negQuat(hand, data.xquat[self.hand])
        mujoco.mju_mulQuat(relative, hand, data.xquat[segment.body])
        offset = (data.xpos[segment.body] - data.xpos[self.hand]) @ rotation
        model.eq_data[segment.weld, :10] = np.concatenate([np.zeros(3), offset, relative])
        data.eq_active[segment.weld] = 1

    def extra_state(self) -> dict[str, np.ndarray]:
        """Welds, the fingers' stop and the bag's yaw."""
        welds = [s.weld for s in self.segments]
        return {"welds": self.model.eq_data[welds].copy(), "stop": np.array(self.stop), "yaw": np.array(self.yaw)}

    def set_extra_state(self, extra: dict[str, np.ndarray]) -> None:
        """Restore `extra_state`."""
        self.model.eq_data[[s.weld for s in self.segments]] = extra["welds"]
        self.stop, self.yaw = float(extra["stop"]), float(extra["yaw"])

    # Privileged truth

    def spilled(self) -> np.ndarray:
        """Which candies are outside the pouch, bool (N,): in no segment's inside, with a margin."""
        data, inside = self.data, np.zeros(self.n_candies, bool)
        at = data.xpos[self.candies]
        # Along the bag, neighbours overlap: a folded bag opens wedges between them. Nothing lies beyond the mouth.
        reach = np.array([0.75 * LENGTH, WIDTH / 2 + SPILL_MARGIN, HEIGHT / 2 + SPILL_MARGIN])
        for body in self.bodies:
            local = (at - data.xpos[body]) @ data.xmat[body].reshape(3, 3)
            within = (np.abs(local) < reach).all(1)
            if body == self.bodies[MOUTH]:
                within &= local[:, 0] < LENGTH / 2 + SPILL_MARGIN
            inside |= within
        return ~inside

    def segment_position(self, k: int) -> np.ndarray:
        """Centre of a segment (3,)."""
        return self.data.xpos[self.bodies[k]].copy()

    def location(self) -> dict[str, float]:
        """Where closed end and middle are as seen from the hand, m, how far it must turn, rad, and all of it enlarged.

        For policies that are told where the bag is, instead of looking: see LOCATION_NAMES.
        """
        hand, rotation = self.tool_pose()
        tail, middle, mouth = map(self.segment_position, (TAIL, MIDDLE, MOUTH))
        bag, turned = mouth - tail, rotation @ POINTING_DOWN.T
        turn = np.arctan2(bag[1], bag[0]) - np.arctan2(turned[1, 0], turned[0, 0])
        turn = (turn + np.pi / 2) % np.pi - np.pi / 2  # the hand looks the same after half a turn
        ways = np.array([*(tail - hand), *(middle - hand), turn])
        return dict(zip(LOCATION_NAMES, np.concatenate([ways, np.tanh(ways / NEAR)]).tolist()))

    def held_segment(self) -> int | None:
        """The segment in the fingers."""
        held = [k for k, s in enumerate(self.segments) if self.data.eq_active[s.weld]]
        return held[0] if held else None

    def truth(self) -> dict[str, float | bool]:
        """Spilled candies, their share as severity, whether the bag is lifted and by what; see the base class."""
        spilled = int(self.spilled().sum())
        held = self.held_segment()
        lifted = held is not None and self.segment_position(held)[2] - _z() > self.lift_height
        return {
            "margin": 0.5 - spilled,
            "failure": spilled > 0,
            "is_success": bool(lifted and not spilled),
            "spilled": spilled,
            "severity": spilled / self.n_candies,
            "lifted": bool(lifted),
            "grasp": -1 if held is None else held,
            "reward": float(lifted and not spilled),
        }


WALL_GAIN, WALL_FORCE = 150.0, 0.35
"""Stiffness (N/m) and largest force (N) with which fingers push a side wall."""


def _x(k: int) -> float:
    """Centre of segment k along the bag, its middle at 0."""
    return (k - (SEGMENTS - 1) / 2) * LENGTH


def _z() -> float:
    """Height of the segments' centres above the table."""
    return HEIGHT / 2 + 2 * FILM


def _heap(n: int, radius: float, rng: np.random.Generator) -> np.ndarray:
    """Positions (n, 3) in two layers, from the closed end of the pouch on."""
    pitch = 2 * radius + 0.0008
    rows = int((WIDTH - 0.002) / pitch)
    index = np.arange(n)
    column, layer, row = index // (2 * rows), index // rows % 2, index % rows
    x = _x(1) - LENGTH / 2 + FILM + radius + 0.002 + column * pitch
    y = (row - (rows - 1) / 2) * pitch
    z = 2 * FILM + radius + layer * pitch
    return np.stack([x, y, z], -1) + np.append(rng.uniform(-3e-4, 3e-4, (n, 2)), np.zeros((n, 1)), 1)


def _scene(variant: Variant, n_candies: int) -> str:
    # The solver must converge: with 15 line-search iterations it now and then threw the bag across the room.
    table = "cloth" if variant.cloth else "wood"
    return f"""
<option timestep="{TIMESTEP}" integrator="implicitfast" cone="elliptic" impratio="3" iterations="100" ls_iterations="50"
  tolerance="1e-8"/>
<default>
  <default class="film">
    <geom type="box" contype="4" conaffinity="2" group="3" friction="{variant.friction} 0.002 0.0001"
      solref="0.008 1"/>
  </default>
  <default class="wall">
    <joint type="slide" range="0 {WIDTH / 2 - 0.005}" solreflimit="0.005 1" stiffness="15" damping="0.4"
      armature="0.005"/>
    <geom type="box" contype="4" conaffinity="2" group="3" friction="0.9 0.01 0.001" solref="0.008 1" condim="4"/>
  </default>
  <default class="fold">
    <joint type="hinge" pos="{-LENGTH / 2} 0 0" damping="0.0025" armature="2e-5"/>
  </default>
  <default class="candy">
    <joint type="slide"/>
    <geom type="sphere" size="{variant.candy_radius}" mass="{variant.candy_mass}" contype="2" conaffinity="2" condim="3"
      friction="{variant.friction} 0.002 0.0001" solref="0.01 1" group="2"/>
  </default>
</default>
<worldbody>
  <geom name="table" type="box" size="0.6 0.6 0.02" pos="0.45 0 -0.02" material="{table}" friction="0.6 0.005 0.0001"
    contype="1" conaffinity="15" solref="0.008 1"/>
  <camera name="front" pos="1.16 0.45 0.44" xyaxes="-0.563 0.826 0 -0.307 -0.210 0.928" fovy="36"/>
  {_segment(0, variant)}
  {"".join(_candy(i) for i in range(n_candies))}
  {variant.beside}
</worldbody>
<deformable>{_skin("film", variant.colour, 1.0)}{_skin("lining", "0.75 0.75 0.78", 0.97)}</deformable>
<equality>{"".join(_grasp(k) for k in range(SEGMENTS))}</equality>"""


def _segment(k: int, variant: Variant) -> str:
    """A segment and all after it."""
    if k == SEGMENTS:
        return ""
    if k == 0:
        place, joints = f"{_x(0)} 0 {_z()}", '<freejoint name="bag"/>'
    else:
        place = f"{LENGTH} 0 0"
        joints = f"""
      <joint class="fold" name="fold_y_{k}" axis="0 1 0" stiffness="{variant.stiffness}" range="-0.8 0.8"/>
      <joint class="fold" name="fold_z_{k}" axis="0 0 1" stiffness="{2 * variant.stiffness}" range="-0.2 0.2"/>"""
    floor = f"{LENGTH / 2 * 1.35} {WIDTH / 2} {FILM}"
    roof = f"{LENGTH / 2 * 1.35} {WIDTH / 2} {THICK}"
    end = LENGTH / 2 + FILM
    parts = [
        f'<geom class="film" size="{floor}" pos="0 0 {-HEIGHT / 2 - FILM}" mass="0.003"/>',
        f'<geom class="film" size="{roof}" pos="0 0 {HEIGHT / 2 + THICK}" mass="0.003"/>',
    ]
    if k == 0:  # what the eye knows the closed end by: a crimped, silvery edge
        parts.append(
            f'<geom class="visual" type="box" size="0.005 {HALF_OUTSIDE} 0.0035" pos="{0.006 - LENGTH / 2} 0 0" '
            'rgba="0.88 0.88 0.9 1"/>'
        )
    if k == 1:  # the seal between tail and pouch
        parts.append(
            f'<geom class="film" size="{THICK} {WIDTH / 2} {HEIGHT / 2}" pos="{-LENGTH / 2 - THICK} 0 0" '
            'mass="0.0002"/>'
        )
    if k == MOUTH and variant.sealed:
        parts.append(
            f'<geom class="film" size="{FILM} {WIDTH / 2 + FILM} {HEIGHT / 2}" pos="{end} 0 0" mass="0.0002"/>'
        )
    elif k == MOUTH:
        for z in (-HEIGHT / 2 + LIP / 2, HEIGHT / 2 - LIP / 2):
            parts.append(f'<geom class="film" size="{FILM} {WIDTH / 2} {LIP / 2}" pos="{end} 0 {z}" mass="0.0001"/>')
    for side, sign in (("left", 1), ("right", -1)):
        parts.append(f"""
      <body name="side_{side}_{k}" pos="0 {sign * (WIDTH / 2 + WALL)} 0">
        <joint class="wall" name="wall_{side}_{k}" axis="0 {-sign} 0"/>
        <geom class="wall" size="{LENGTH / 2 * 1.2} {THICK} {HEIGHT / 2 - 0.001}" pos="0 {sign * (THICK - WALL)} 0"
          mass="0.0015"/>
      </body>""")
    return f'<body name="segment_{k}" pos="{place}">{joints}{"".join(parts)}{_segment(k + 1, variant)}</body>'


def _candy(i: int) -> str:
    axes = "".join(f'<joint class="candy" axis="{axis}"/>' for axis in ("1 0 0", "0 1 0", "0 0 1"))
    colour = CANDY_COLOURS[i % len(CANDY_COLOURS)]
    return f'<body name="candy_{i}" pos="0 0 1">{axes}<geom class="candy" rgba="{colour} 1"/></body>'


def _grasp(k: int) -> str:
    return (
        f'<weld name="grasp_{k}" body1="hand" body2="segment_{k}" active="false" solref="0.03 1" torquescale="0.03"/>'
    )


def _skin(name: str, colour: str, shrink: float) -> str:
    """A tube of eight vertices a row over the segments, each vertex on one bone; `shrink` < 1 is the inner lining."""
    vertices: list[tuple[float, float, float]] = []
    bones: dict[tuple[str, int], list[int]] = {}
    z = HEIGHT / 2 + 2 * FILM
    around = [  # (bone, y, z), once around
        ("side_left", HALF_OUTSIDE, -0.55 * HEIGHT / 2), ("side_left", HALF_OUTSIDE, 0.55 * HEIGHT / 2),
        ("segment", WIDTH / 4, z), ("segment", -WIDTH / 4, z),
        ("side_right", -HALF_OUTSIDE, 0.55 * HEIGHT / 2), ("side_right", -HALF_OUTSIDE, -0.55 * HEIGHT / 2),
        ("segment", -WIDTH / 4, -z), ("segment", WIDTH / 4, -z),
    ]  # fmt: skip
    end = LENGTH / 2
    # x, segment, scale of y, scale of z: the flat tail, the shoulder of the pouch, then one row a segment.
    rows = [(_x(0) - end, 0, 1.05, 0.06), (_x(0), 0, 1.05, 0.10), (_x(0) + 0.8 * end, 0, 1.0, 0.35)]
    rows += [(_x(k), k, 1.0, 1.0) for k in range(1, SEGMENTS)] + [(_x(MOUTH) + end + 0.004, MOUTH, 1.02, 0.9)]
    for x, k, scale_y, scale_z in rows:
        for bone, y, height in around:
            bones.setdefault((bone, k), []).append(len(vertices))
            vertices.append((x, y * scale_y * shrink, _z() + height * scale_z * shrink))
    faces = []
    for a in range(0, 8 * (len(rows) - 1), 8):
        for i in range(8):
            p, q, r, s = a + i, a + (i + 1) % 8, a + 8 + (i + 1) % 8, a + 8 + i
            faces += [(p, q, r), (p, r, s)] if shrink == 1 else [(r, q, p), (s, r, p)]
    offset = {"segment": 0.0, "side_left": WIDTH / 2 + WALL, "side_right": -WIDTH / 2 - WALL}
    hung = "".join(
        f'<bone body="{bone}_{k}" bindpos="{_x(k)} {offset[bone]} {_z()}" bindquat="1 0 0 0" '
        f'vertid="{_text(ids)}" vertweight="{_text([1] * len(ids))}"/>'
        for (bone, k), ids in bones.items()
    )
    flat = lambda rows: _text(value for row in rows for value in row)  # noqa: E731
    return f'<skin name="{name}" rgba="{colour} 1" vertex="{flat(vertices)}" face="{flat(faces)}">{hung}</skin>'


def _text(values) -> str:
    return " ".join(f"{value:.6g}" for value in values)


assert HALF_OUTSIDE < GRIPPER_WIDTH / 2, "the open fingers must fit around the bag"
