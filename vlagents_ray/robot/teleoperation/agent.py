"""An agent that is a human: demonstrations, in the same loop as a policy."""

from __future__ import annotations

from vlagents_ray.chunking.control import Leader
from vlagents_ray.contract import Contract
from vlagents_ray.interface import INTERVENTION, Act, Agent, Obs


class TeleoperatedAgent(Agent):
    """An agent whose actions are all a leader's, engaged or not; there is no policy.

    Args:
        leader: What the human moves the robot with.
        contract: What the robot gives and takes, for the loop's guard.
    """

    def __init__(self, leader: Leader, contract: Contract | None = None) -> None:
        self._leader, self._contract = leader, contract

    @property
    def contract(self) -> Contract | None:
        """The contract of the robot, as it was given."""
        return self._contract

    def act(self, obs: Obs) -> Act:
        """Return the human's action, (D,) float32, with `info["intervention"]`."""
        self._leader.engaged()  # reads what has been pressed
        return Act(self._leader.action(obs), info={INTERVENTION: True})
