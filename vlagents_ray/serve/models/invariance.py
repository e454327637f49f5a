"""Whether the bits of an action depend on the batch in which it is computed.

They do not if each forward pass has the same number of rows, and if each place of a pass computes
the same bits, or if each action is computed alone.
"""

from __future__ import annotations

from vlagents_ray.interface import Agent
from vlagents_ray.policies.loading import LoadingReport
from vlagents_ray.policies.wrapper import Wrapper


def batch_variation(agent: Agent, report: LoadingReport, largest: int) -> str | None:
    """Return why the bits of an action may depend on its batch; None if they do not.

    Args:
        agent: The loaded agent, with its wrappers.
        report: The report of its loading.
        largest: The largest number of observations in a batch.
    """
    if largest == 1:
        return None

    while isinstance(agent, Wrapper):
        cls = type(agent)
        if cls.change_batch is not Wrapper.change_batch and not cls.repeatable:
            return f"{cls.__name__} changes the observations of a batch together"
        agent = agent.agent

    if type(agent).act_batch is Agent.act_batch:  # calls `act` of each session
        return None
    if report.pads:
        return report.variation
    return (
        f"{type(agent).__name__}.act_batch computes a batch in a way that the server does not "
        "know (derive it from ModelPolicy, or define only `act`)"
    )
