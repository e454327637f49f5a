"""The modes in which policies in real time and on robots executed their chunks."""

from __future__ import annotations

from typing import Any

from vlagents_ray.chunking.choice import choose_from
from vlagents_ray.evaluate.plan.config import ClockConfig
from vlagents_ray.evaluate.results.reader import CaseResults, Results


def modes(results: Results) -> list[str]:
    """Return a line for each policy and suite in real time or on a robot: the mode, the reason, and
    the measured success. Policies whose server reported no metadata are left out.
    """
    lines: dict[str, None] = {}
    for case in results.cases:
        metadata = results.policies.get(case.policy) or {}
        arguments = _arguments(case)
        if arguments is not None and "contract" in metadata:
            name = " ".join(filter(None, (case.policy_id, case.suite)))
            lines[f"{name}: {choose_from(metadata, **arguments).line}"] = None
    return [*lines]


def _arguments(case: CaseResults) -> dict[str, Any] | None:
    """Return the arguments with which the mode of a case was chosen; None if the environment waits
    for the policy.
    """
    execute = case.settings.get("execute")
    robot, clock = case.settings.get("robot"), case.settings.get("clock")
    if robot is not None:
        return {"mode": robot["mode"], "hz": robot["hz"], "execute": execute}
    if clock is None:
        return None
    hz = case.contract.get("control_hz")
    return ClockConfig.model_validate(clock).choice(execute, hz)
