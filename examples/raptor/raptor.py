"""Serve RAPTOR (https://arxiv.org/abs/2509.11481), a recurrent policy that can fly quadrotors that
were not in its training.

Its trained weights are on PyPI: `pip install foundation-policy==1.0.2` (MIT). In this folder
`vlagents-ray serve raptor.yaml` serves it, and `vlagents-ray eval flights.yaml` flies 500
quadrotors with it.
"""

from pathlib import Path

import numpy as np

from vlagents_ray import Act, ActionSpec, Contract, StateSpec, TrainableAgent
from vlagents_ray.policies.base.checkpoint import find_checkpoint
from vlagents_ray.registry import require

INPUTS = {  # parts of the state, in the order of the network's 22 inputs
    "position": StateSpec(3, "m"),  # position relative to the target; x forward, y left, z up
    # Rotation matrix from the body's axes to the world's axes, row by row.
    "rotation": StateSpec(9),
    "velocity": StateSpec(3, "m/s"),
    "angular_velocity": StateSpec(3, "rad/s"),  # angular velocity in the body's axes
    "previous_action": StateSpec(4),
}


class Raptor(TrainableAgent):
    """A gated recurrent unit (GRU) between dense layers; an action sets the motors clockwise
    from front right.
    """

    trainable = "weights"
    # A resumed session receives its last 128 observations again. The GRU forgets earlier ones, so
    # that its actions are equal up to 3e-7.
    contract = Contract(
        state=INPUTS, action=ActionSpec(dim=4, space="rotor_speed"), control_hz=100.0, history=129
    )

    def initialize(self):
        folder = Path(require("foundation_policy").__file__).parent
        with require("h5py").File(find_checkpoint(str(folder / "blob" / "checkpoint.h5"))) as file:
            layers = file["actor/layers"]
            names = [f"{number}/{name}" for number in layers for name in layers[number]]
            # float32.
            self.weights = {name: np.squeeze(layers[name]["parameters"]) for name in names}

    def reset(self, obs, instruction, **kwargs):
        self.hidden = self.weights["1/initial_hidden_state"]  # (16,)
        return {}

    def observe(self, obs):
        self.act(obs)

    def act_batch(self, obs, sessions):
        inputs = np.stack(
            [np.concatenate([one.state[name] for name in INPUTS]) for one in obs]
        ).astype(np.float32)
        hidden = np.stack([session.hidden for session in sessions])
        new = self._dense("1/%s_input", np.maximum(self._dense("0/%s", inputs), 0))
        old = self._dense("1/%s_hidden", hidden)
        reset, update = np.split(1 / (1 + np.exp(-(new + old)[:, :32])), 2, axis=1)
        hidden = update * hidden + (1 - update) * np.tanh(new[:, 32:] + reset * old[:, 32:])
        for session, row in zip(sessions, hidden, strict=True):
            session.hidden = row
        return [Act(action) for action in self._dense("2/%s", hidden)]

    def _dense(self, name, inputs):
        """Multiply vector by vector, so that an action is bit-identical in any batch."""
        return (self.weights[name % "weights"] @ inputs[..., np.newaxis])[..., 0] + self.weights[
            name % "biases"
        ]
