"""Exact safety values of the Dubins car: what every learned monitor is compared with.

Two truths, because they differ and the paper's table uses the second:

* `discrete`: the discrete-time car with the paper's three turn rates, by an oracle for any state
  (`exact_value`) or by grid value iteration (`solve_grid`).
* `continuous`: continuous time, |u| <= 1.25 rad/s, by hj_reachability on the paper's grid (`solve_continuous`).

V(s) is the largest, over action sequences, of the smallest margin l along the way; V <= 0 is unsafe.
"""

from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.interpolate import RegularGridInterpolator
from scipy.ndimage import map_coordinates

from lerobot_latentsafe.dubins import car

PAPER_GRID = ((-1.1, 1.1, 51), (-1.1, 1.1, 51), (0.0, 2 * np.pi, 53))
"""x, y and heading: (low, high, points); the heading is periodic, so its high end is excluded."""


def exact_value(
    states: np.ndarray, turn_rates: Sequence[float] = tuple(car.TURN_RATES), n_steps: int = 80
) -> np.ndarray:
    """Safety value of any states (N, 3) -> (N,) in m^2, for the discrete-time car.

    The disc is rotation-symmetric, so the best sequence holds one turn rate until the disc is passed. Simulating each
    constant action agrees in sign with value iteration on more than 99.9% of the states of a grid (tests check it);
    where they differ, |V| is below 0.01. With only {0, a_max} the best sequence is constant or one switch between the
    two, so switches are searched as well.
    """
    states = np.asarray(states, float)
    best = np.full(len(states), -np.inf)
    for first in turn_rates:
        for second in turn_rates:
            # Three symmetric actions need no switch; a one-sided set may turn first and then go straight.
            switches = [0] if first == second else ([] if len(turn_rates) == 3 else range(1, 40, 2))
            for switch in switches:
                best = np.maximum(best, _worst_margin(states, first, second, switch, n_steps))
    return best


def _worst_margin(states: np.ndarray, first: float, second: float, switch: int, n_steps: int) -> np.ndarray:
    worst = car.margin(states)
    for t in range(n_steps):
        states = car.step(states, np.full(len(states), first if t < switch else second))
        worst = np.minimum(worst, car.margin(states))
    return worst


def grid_states(grid: tuple = PAPER_GRID) -> np.ndarray:
    """All nodes of a grid as states: (nx * ny * nheading, 3), heading fastest."""
    (x0, x1, nx), (y0, y1, ny), (h0, h1, nh) = grid
    axes = np.linspace(x0, x1, nx), np.linspace(y0, y1, ny), np.linspace(h0, h1, nh, endpoint=False)
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)


def solve_grid(
    n: int = 101, n_headings: int = 60, half_width: float = 1.5, turn_rates: Sequence[float] | None = None,
    margin: Callable[[np.ndarray], np.ndarray] = car.margin,
) -> tuple[np.ndarray, int]:  # fmt: skip
    """Undiscounted grid value iteration V = min(l, max_u V(f(s, u))), trilinear, periodic heading.

    Leaving the grid counts as safe for ever, which is immaterial this far from the disc.

    Args:
        margin: l of states (N, 3) -> (N,), of another failure than the disc.

    Returns:
        V (n, n, n_headings) on [-half_width, half_width]^2 x [0, 2 pi) and the number of sweeps.
    """
    turn_rates = car.TURN_RATES if turn_rates is None else np.asarray(turn_rates)
    grid = ((-half_width, half_width, n), (-half_width, half_width, n), (0.0, 2 * np.pi, n_headings))
    states = grid_states(grid)
    l = margin(states)
    successors = [car.step(states, u) for u in turn_rates]
    scale = np.array([(n - 1) / (2 * half_width)] * 2 + [n_headings / (2 * np.pi)])
    offset = np.array([half_width, half_width, 0.0])
    coordinates = [((s + offset) * scale).T for s in successors]
    outside = [np.abs(s[:, :2]).max(-1) > half_width for s in successors]
    V = l.copy()
    for sweep in range(1, 200):
        # One wrapped column on each side makes the linear interpolation periodic in the heading.
        padded = np.pad(V.reshape(n, n, n_headings), ((0, 0), (0, 0), (1, 1)), mode="wrap")
        best = np.full(len(V), -np.inf)
        for c, out in zip(coordinates, outside):
            c = np.stack([c[0], c[1], np.mod(c[2], n_headings) + 1])
            best = np.maximum(best, np.where(out, np.inf, map_coordinates(padded, c, order=1, mode="nearest")))
        updated = np.minimum(l, best)
        if np.abs(updated - V).max() < 1e-6:
            return updated.reshape(n, n, n_headings), sweep
        V = updated
    raise RuntimeError("value iteration did not converge in 200 sweeps; refine the grid")


@lru_cache(maxsize=2)
def solve_continuous(grid: tuple = PAPER_GRID) -> np.ndarray:
    """The paper's truth: the continuous-time value on a grid (nx, ny, nheading), by hj_reachability.

    Raises:
        ImportError: the extra `ground-truth` is not installed.
    """
    try:
        import hj_reachability as hj
        import jax.numpy as jnp
    except ImportError as e:
        raise ImportError(
            "--truth=continuous needs hj_reachability; install it with "
            "pip install 'lerobot_policy_latentsafe[ground-truth]', or use --truth=discrete"
        ) from e

    class Car(hj.ControlAndDisturbanceAffineDynamics):
        def __init__(self):
            super().__init__(
                "max", "min",
                hj.sets.Box(jnp.array([-car.MAX_TURN_RATE]), jnp.array([car.MAX_TURN_RATE])),
                hj.sets.Box(jnp.array([0.0]), jnp.array([0.0])),
            )  # fmt: skip

        def open_loop_dynamics(self, state, time):
            return jnp.array([car.SPEED * jnp.cos(state[2]), car.SPEED * jnp.sin(state[2]), 0.0])

        def control_jacobian(self, state, time):
            return jnp.array([[0.0], [0.0], [1.0]])

        def disturbance_jacobian(self, state, time):
            return jnp.zeros((3, 1))

    (x0, x1, nx), (y0, y1, ny), (h0, h1, nh) = grid
    hj_grid = hj.Grid.from_lattice_parameters_and_boundary_conditions(
        hj.sets.Box(np.array([x0, y0, h0]), np.array([x1, y1, h1])), (nx, ny, nh), periodic_dims=2
    )
    l = hj_grid.states[..., 0] ** 2 + hj_grid.states[..., 1] ** 2 - car.RADIUS**2
    settings = hj.SolverSettings.with_accuracy(
        "very_high", hamiltonian_postprocessor=hj.solver.backwards_reachable_tube
    )
    # After 2.5 s every trajectory has passed the disc: the value no longer changes.
    return np.asarray(hj.step(settings, Car(), hj_grid, 0.0, l, -2.5, progress_bar=False))


def truth_on(states: np.ndarray | None, truth: str) -> tuple[np.ndarray, np.ndarray]:
    """States to score and their true values.

    Args:
        states: (N, 3), or None for the paper's grid.
        truth: `discrete` or `continuous`; between the nodes `continuous` is interpolated.

    Returns:
        states (N, 3) and V (N,).
    """
    if truth not in ("discrete", "continuous"):
        raise ValueError(f"--truth is {truth!r}; expected 'discrete' or 'continuous'")
    nodes = states is None
    states = grid_states() if nodes else states
    if truth == "discrete":
        return states, exact_value(states)
    V = solve_continuous()
    if nodes:
        return states, V.reshape(-1)
    (x0, x1, nx), (y0, y1, ny), (_, h1, nh) = PAPER_GRID
    axes = np.linspace(x0, x1, nx), np.linspace(y0, y1, ny), np.linspace(0, h1, nh + 1)
    periodic = np.concatenate([V, V[..., :1]], -1)
    inside = np.clip(states, [x0, y0, -np.inf], [x1, y1, np.inf])
    inside[:, 2] %= 2 * np.pi
    return states, RegularGridInterpolator(axes, periodic)(inside)


def load_states(path: str | Path) -> np.ndarray:
    """Read `--states=FILE.npy`: finite (N, 3) x, y, heading.

    Raises:
        ValueError: the file has another shape or holds non-finite numbers.
    """
    states = np.load(path, allow_pickle=False)
    if states.ndim != 2 or states.shape[1] != 3 or not len(states) or not np.isfinite(states).all():
        raise ValueError(f"{path} holds an array of shape {states.shape}; expected finite (N, 3): x, y, heading")
    return states.astype(float)


def sample_task_start(rng: np.random.Generator, min_value: float = 0.1) -> np.ndarray:
    """A start at the left edge, facing the goal, roughly; safety is feasible with room: V > min_value (m^2)."""
    while True:
        y = rng.uniform(-0.6, 0.6)
        state = np.array([rng.uniform(-1.0, -0.85), y, np.arctan2(-y, 1.8) + rng.uniform(-0.5, 0.5)])
        if exact_value(state[None])[0] > min_value:
            return state
