"""The policy Homing, which moves each joint towards zero."""

import numpy as np

from vlagents_ray import Act, ActionSpec, Agent, Contract, StateSpec


class Homing(Agent):
    """Moves three joints by a tenth of their distance to zero in each call."""

    contract = Contract(state={"joints": StateSpec(3, "rad")}, action=ActionSpec(dim=3, delta=True))

    def act(self, obs):
        """Return a change of the joints, (3,) float32, rad."""
        return Act(np.asarray(-0.1 * obs.state["joints"], np.float32))
