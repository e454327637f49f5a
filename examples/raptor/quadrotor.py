"""Simulated quadrotors of random size, mass, motors and disturbance, which must fly to a target and
hover there.

Dynamics, distribution and conventions are the same as in the training of RAPTOR
(https://arxiv.org/abs/2509.11481) in https://github.com/rl-tools/rl-tools, commit cda0a54e:
include/rl_tools/rl/environments/l2f/operations_generic and
src/foundation_policy/pre_training/sample_dynamics_parameters.cpp. `python quadrotor.py` checks the
environment.
"""

import numpy as np

from vlagents_ray import ActionSpec, Contract, Obs, StateSpec
from vlagents_ray.envs import EvalEnv
from vlagents_ray.envs.base import BatchEnv, one_row
from vlagents_ray.testing import check_env

DT = 0.01  # s
GRAVITY = 9.81  # m/s²
# The distribution scales the values of the Crazyflie: the thrust of a rotor as a polynomial in its
# speed in [0, 1], here as a share of the largest thrust; the moments of inertia about x, y and z,
# here in units of the first; the distance of the rotors from the body's x and y axes, m; and the
# mass, kg.
THRUST = np.array([0.00352526, 0.01437313, 0.09223048]) / 0.11012887
INERTIA = np.array([9.416556729130406, 9.644051701582312, 17.45951732253285]) / 9.416556729130406
ARM, MASS = 0.028, 0.0306
# As in the training, a flight ends beyond 20 times the distance of the rotors from the centre, or
# beyond 35 rad/s. The training's limit of 2 m/s is not used, since quadrotors of all sizes begin
# with up to 1 m/s in each direction, tilted and with slow rotors.
FARTHEST, LARGEST_RATE = 20, 35.0
HOVER_M, HOVER_STEPS = 0.2, 100  # success: within this distance of the target for 1 s


def sample(rng):
    """Draw a quadrotor and its state at the start of a flight.

    Args:
        rng: A `numpy.random.Generator`.

    Returns:
        The quadrotor, its values by name, and the state of `Quadrotors`, (17,).
    """
    thrust_to_weight = rng.uniform(1.5, 5.0)
    mass = rng.uniform(np.cbrt(0.02), np.cbrt(5.0)) ** 3  # kg; the size is uniformly distributed
    deviation = rng.normal(-0.1, 0.1)  # the source also uses the lower end of the range as the mean
    arm = ARM * np.cbrt(mass / MASS) * (1 / (1 - deviation) if deviation < 0 else 1 + deviation)
    thrust = thrust_to_weight * mass * GRAVITY / 4  # largest thrust of one rotor, N
    quadrotor = {
        "mass": mass,
        "arm": arm,
        "thrust": thrust,
        # Moment of inertia about x, kg m², from the torque and a random acceleration, rad/s².
        "inertia": np.sqrt(2) * arm * thrust / rng.uniform(40.0, 1200.0),
        # Torque of a rotor about z divided by its thrust, m.
        "torque_constant": rng.uniform(0.005, 0.05),
        "rising": rng.uniform(0.03, 0.10),  # time constant of accelerating motors, s
        "falling": rng.uniform(0.03, 0.30),  # time constant of decelerating motors, s
    }
    spread = rng.uniform(0, 0.3 * (thrust_to_weight - 1)) * thrust_to_weight * mass / 3
    # Force of the disturbance along each axis, N.
    quadrotor |= {
        f"force_{axis}": force for axis, force in zip("xyz", rng.normal(0, spread, 3), strict=True)
    }
    state = np.zeros(17)
    state[3] = 1.0
    state[13:] = rng.uniform(0, 0.5, 4)
    if rng.uniform() >= 0.1:  # One tenth of the flights begin at the target and at rest.
        state[:3] = rng.uniform(-1, 1, 3) * 10 * np.sqrt(2) * arm
        axis, angle = rng.normal(size=3), rng.uniform(0, 1)  # rad
        state[3:7] = [np.cos(angle / 2), *np.sin(angle / 2) * axis / np.linalg.norm(axis)]
        state[7:13] = rng.uniform(-1, 1, 6)
    return quadrotor, state


class Quadrotors:
    """N quadrotors that fly at the same time without affecting each other, since all arithmetic is
    elementwise.

    Attributes:
        state: (17, N), the position, m; the orientation, a quaternion wxyz; the velocity, m/s; the
            angular velocity in the body's axes, rad/s; and the speeds of the rotors in [0, 1].
        action: (4, N), the last action; initially, the action that keeps the rotors' speeds.
        parameters: The values of the quadrotors by name, each (N,), in the units of `sample`.
    """

    def __init__(self, seeds):
        """Begin a flight for each seed, which determines the quadrotor and its start."""
        drawn = [sample(np.random.default_rng(seed)) for seed in seeds]
        self.parameters = {
            name: np.array([quadrotor[name] for quadrotor, _ in drawn]) for name in drawn[0][0]
        }
        self.state = np.stack([state for _, state in drawn], axis=1)
        self.action = 2 * self.state[13:] - 1
        # Distance of the rotors from the centre, (N,) m.
        self.radius = np.sqrt(2) * self.parameters["arm"]

    def step(self, action, flying=True):
        """Fly for `DT` with an action, (4, N), which sets the rotors' speeds: -1 means speed 0, and
        1 means speed 1.

        Quadrotors that are not `flying`, (N,) bool, do not change.
        """
        self.action = np.where(flying, action, self.action)
        command = (np.clip(self.action, -1, 1) + 1) / 2
        k1 = self._derivative(self.state, command)
        k2 = self._derivative(self.state + DT / 2 * k1, command)
        k3 = self._derivative(self.state + DT / 2 * k2, command)
        k4 = self._derivative(self.state + DT * k3, command)
        state = self.state + DT / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        w, x, y, z = state[3:7]
        state[3:7] /= np.sqrt(w * w + x * x + y * y + z * z)
        state[13:] = np.clip(state[13:], 0, 1)
        self.state = np.where(flying, state, self.state)

    def _derivative(self, state, command):
        body = self.parameters
        (w, x, y, z), (p, q, r), rotors = state[3:7], state[10:13], state[13:]
        # The rotors are at front right, back right, back left and front left.
        t0, t1, t2, t3 = body["thrust"] * (
            THRUST[0] + THRUST[1] * rotors + THRUST[2] * rotors * rotors
        )
        lift = t0 + t1 + t2 + t3
        torque_x = body["arm"] * (-t0 - t1 + t2 + t3)
        torque_y = body["arm"] * (-t0 + t1 + t2 - t3)
        torque_z = body["torque_constant"] * (-t0 + t1 - t2 + t3)
        jx, jy, jz = (body["inertia"] * ratio for ratio in INERTIA)
        time_constant = np.where(command >= rotors, body["rising"], body["falling"])
        return np.stack(
            [
                *state[7:10],
                0.5 * (-x * p - y * q - z * r),
                0.5 * (w * p + y * r - z * q),
                0.5 * (w * q + z * p - x * r),
                0.5 * (w * r + x * q - y * p),
                ((2 * x * z + 2 * w * y) * lift + body["force_x"]) / body["mass"],
                ((2 * y * z - 2 * w * x) * lift + body["force_y"]) / body["mass"],
                ((1 - 2 * x * x - 2 * y * y) * lift + body["force_z"]) / body["mass"] - GRAVITY,
                (torque_x - (jz - jy) * q * r) / jx,
                (torque_y - (jx - jz) * r * p) / jy,
                (torque_z - (jy - jx) * p * q) / jz,
                *((command - rotors) / time_constant),
            ]
        )

    def distance(self):
        """Return the distances to the target, (N,) m."""
        x, y, z = self.state[:3]
        return np.sqrt(x * x + y * y + z * z)

    def crashed(self):
        """Return which flights are over, (N,) bool."""
        far = np.abs(self.state[:3]) > FARTHEST * self.radius
        return (far | (np.abs(self.state[10:13]) > LARGEST_RATE)).any(axis=0)

    def observe(self):
        """Return the policy's inputs by name, each (N, D) float32."""
        w, x, y, z = self.state[3:7]
        rotation = [
            *(1 - 2 * y * y - 2 * z * z, 2 * x * y - 2 * w * z, 2 * x * z + 2 * w * y),
            *(2 * x * y + 2 * w * z, 1 - 2 * x * x - 2 * z * z, 2 * y * z - 2 * w * x),
            *(2 * x * z - 2 * w * y, 2 * y * z + 2 * w * x, 1 - 2 * x * x - 2 * y * y),
        ]
        parts = {
            "position": self.state[:3],
            "rotation": np.stack(rotation),
            "velocity": self.state[7:10],
            "angular_velocity": self.state[10:13],
            "previous_action": self.action,
        }
        return {name: np.ascontiguousarray(part.T, np.float32) for name, part in parts.items()}


class HoverBatch(BatchEnv):
    """Simultaneous flights of 5 s, in which quadrotors fly to the target and stay there."""

    max_steps = 500
    contract = Contract(  # conventions of https://pypi.org/project/foundation-policy
        state={
            "position": StateSpec(3, "m"),
            "rotation": StateSpec(9),
            "velocity": StateSpec(3, "m/s"),
            "angular_velocity": StateSpec(3, "rad/s"),
            "previous_action": StateSpec(4),
        },
        action=ActionSpec(dim=4, space="rotor_speed"),
        control_hz=1 / DT,
    )

    def __init__(self, num_envs):
        self.num_envs = num_envs

    @property
    def instructions(self):
        return ["hover at the target"] * len(self.near)

    def reset(self, *, seeds, options=None):
        """Begin a flight for each seed, which determines the quadrotor."""
        self.flights, self.steps, self.near = Quadrotors(seeds), 0, np.zeros(len(seeds), int)
        return self._observe()

    def step(self, acts):
        """Fly for 10 ms. The reward is the negative distance to the target, m."""
        flying = np.array([act is not None for act in acts])
        rows = [np.zeros(4) if act is None else one_row(act, self.contract) for act in acts]
        self.flights.step(np.stack(rows, axis=1), flying)
        self.steps += 1
        distance = self.flights.distance()
        self.near = np.where(distance < HOVER_M, self.near + 1, 0)
        infos = [{"success": bool(near >= HOVER_STEPS)} for near in self.near]
        truncated = [self.steps >= self.max_steps] * len(acts)
        return (
            self._observe(),
            (-distance).tolist(),
            self.flights.crashed().tolist(),
            truncated,
            infos,
        )

    def _observe(self):
        parts = self.flights.observe()
        return [
            Obs(state={name: part[i] for name, part in parts.items()})
            for i in range(len(self.near))
        ]

    def close(self):
        """Free nothing."""


class Hover(EvalEnv):
    """A single flight of `HoverBatch`."""

    max_steps = HoverBatch.max_steps
    contract = HoverBatch.contract
    instruction = "hover at the target"

    def __init__(self):
        self._batch = HoverBatch(1)

    @classmethod
    def batched(cls, num_envs):
        return HoverBatch(num_envs)

    def reset(self, *, seed, options=None):
        [obs] = self._batch.reset(seeds=[seed])
        return obs, {}

    def step(self, act):
        return tuple(one for [one] in self._batch.step([act]))

    def close(self):
        """Free nothing."""


if __name__ == "__main__":
    check_env(Hover())  # raises an error that lists all problems
    print("Hover keeps its contract")
