"""The registered devices with which an operator moves a robot, and an agent that returns an
operator's actions.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from typing import Protocol

import numpy as np

from vlagents_ray.chunking.control import Leader
from vlagents_ray.contract import Contract
from vlagents_ray.errors import ConfigError, VLAgentsError
from vlagents_ray.interface import INTERVENTION, Act, Agent, Obs
from vlagents_ray.registry import registered_function
from vlagents_ray.robot.loop import import_class

__all__ = ["Leader", "OpenLeader", "TeleoperatedAgent", "leader_named"]

LEADER = ("engaged", "action")  # names of the methods of a `Leader`
Measure = Callable[[Obs], np.ndarray]  # returns the robot's pose from an observation, (D,)


class OpenLeader(Protocol):
    """The interface of a function that opens an operator's device.

    A leader may have an attribute `help`, a line that explains how to use the device; the command
    line prints this line.
    """

    def __call__(
        self, contract: Contract | None, /, *, step: float | None, measure: Measure | None
    ) -> AbstractContextManager[Leader]:
        """Open the device.

        Args:
            contract: The contract of the policy or the environment.
            step: The change of a number of the action per tick; None uses a value that suits the
                contract.
            measure: Returns the robot's measured pose; None uses the state part `joints`.

        Returns:
            A context manager that yields the leader and closes the device at the end.
        """


def leader_named(option: str, name: str) -> OpenLeader:
    """Return the function that opens an operator's device.

    Args:
        option: The option that names the device, such as "--teleop", for errors.
        name: A registered name, such as "keyboard", or "module:Class", a class whose constructor
            needs no arguments.

    Returns:
        The function, which opens the device for a contract.

    Raises:
        ConfigError: There is no such device, or the class lacks a method of `Leader`.
    """
    if ":" in name:
        make = import_class(option, name, LEADER)

        def open_class(
            contract: Contract | None, /, *, step: float | None, measure: Measure | None
        ) -> AbstractContextManager[Leader]:
            """Make a leader of the user's class."""
            del contract, step, measure  # the user's class has its own settings
            return _opened(f"{option} {name}", make)

        return open_class

    open_leader: OpenLeader = registered_function("leaders", name)
    return open_leader


@contextlib.contextmanager
def _opened(where: str, make: Callable[[], Leader]) -> Iterator[Leader]:
    """Make a leader of the user's class, and close it at the end if it is a context manager."""
    try:
        leader = make()
    except VLAgentsError:
        raise
    except Exception as error:
        raise ConfigError(
            f"{where}: expected a class that can be made without arguments, got "
            f"{type(error).__name__}: {error}"
        ) from error
    if isinstance(leader, AbstractContextManager):
        with leader as entered:
            yield entered
    else:
        yield leader


class TeleoperatedAgent(Agent):
    """An agent that returns, in place of a policy, the action of a leader at each tick, whether the
    leader is engaged or not.

    Args:
        leader: The device with which the operator moves the robot.
        contract: The contract of the robot, for the loop's guard.
    """

    contract: Contract | None = None

    def __init__(self, leader: Leader, contract: Contract | None = None) -> None:
        self._leader = leader
        self.contract = contract

    def act(self, obs: Obs) -> Act:
        """Return the operator's action, (D,) float32, with `info["intervention"]`."""
        self._leader.engaged()  # this call reads the device
        return Act(self._leader.action(obs), info={INTERVENTION: True})

    def interrupt(self) -> None:
        """Let absolute targets begin at the measured pose again, after the robot was stopped."""
        rebase = getattr(self._leader, "rebase", None)
        if rebase is not None:
            rebase(None)
