"""The number of replicas for a measured load, with constructed loads."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import yaml
from pydantic import ValidationError
from ray.serve._private.common import DeploymentID, ReplicaID
from ray.serve.config import AutoscalingConfig, AutoscalingContext

from vlagents_ray.serve.config.deployment import AutoscalingArgs, ServerArgs
from vlagents_ray.serve.scaling.autoscaling import SESSIONS, UTILISATION, MeasuredLoad

POLICY = DeploymentID("Policy", "app")


def context_of(
    utilisation: list[float],
    *,
    sessions: float = 0.0,
    target: int | None = None,
    running: int | None = None,
    requests: float = 0.0,
    now: float = 0.0,
    state: dict[str, Any] | None = None,
) -> AutoscalingContext:
    """Return the context that Serve passes to the policy. Each reporting replica has its entry of
    `utilisation`, and the same number of sessions.
    """
    replicas = [ReplicaID(str(i), POLICY) for i in range(len(utilisation))]
    return AutoscalingContext(
        deployment_id=POLICY,
        deployment_name="Policy",
        app_name="app",
        current_num_replicas=len(replicas) if running is None else running,
        target_num_replicas=len(replicas) if target is None else target,
        running_replicas=replicas,
        total_num_requests=requests,
        total_queued_requests=0.0,
        aggregated_metrics={
            UTILISATION: dict(zip(replicas, utilisation, strict=True)),
            SESSIONS: dict.fromkeys(replicas, sessions),
        }
        if replicas
        else {},
        raw_metrics={},
        capacity_adjusted_min_replicas=0,
        capacity_adjusted_max_replicas=100,
        policy_state=state or {},
        last_scale_up_time=None,
        last_scale_down_time=None,
        current_time=now,
        config=None,
    )


def requested(policy: MeasuredLoad, utilisation: list[float], **load: Any) -> int:
    """Return the decision of the first call."""
    number, _ = policy(context_of(utilisation, **load))
    return number


def test_busy_replicas_get_help_and_idle_ones_leave() -> None:
    policy = MeasuredLoad()
    assert requested(policy, [0.65]) == 1
    assert requested(policy, [0.95]) == 2
    assert requested(policy, [1.0, 1.0, 1.0]) == 5
    assert requested(policy, [0.1, 0.1, 0.1], sessions=1) == 1


def test_sessions_count_only_if_a_target_is_set() -> None:
    assert requested(MeasuredLoad(), [0.1], sessions=100, target=1) == 1
    assert requested(MeasuredLoad(target_sessions=32), [0.1], sessions=100) == 4


def test_utilisation_waits_for_its_delay_and_sessions_do_not() -> None:
    policy, state = MeasuredLoad(target_sessions=8, busy_s=7.0), {}

    def at(now: float, utilisation: float, sessions: float = 5.0) -> int:
        nonlocal state
        number, state = policy(context_of([utilisation], sessions=sessions, now=now, state=state))
        return number

    assert at(100.0, 1.0) == 1
    assert at(106.9, 1.0) == 1
    assert at(107.0, 1.0) == 2
    assert at(108.0, 0.1) == 1, "a break"
    assert at(109.0, 1.0) == 1
    assert at(110.0, 1.0, sessions=17) == 3
    assert at(116.0, 1.0) == 2


def test_around_a_target_the_number_stays() -> None:
    """The load varies around the limit for two replicas, and is measured after each decision."""
    policy, replicas, changes = MeasuredLoad(target_utilisation=0.7), 1, 0
    for step in range(200):
        load = 0.7 + (0.05 if step % 2 else -0.05)
        number = requested(policy, [load / replicas] * replicas, sessions=1)
        changes += number != replicas
        replicas = number
    assert (replicas, changes) == (2, 1)


def test_hidden_load_is_found_in_a_few_steps() -> None:
    """Utilisation cannot exceed 1, so a load of four times the capacity needs several decisions."""
    replicas, steps = 1, []
    for _ in range(10):
        replicas = requested(MeasuredLoad(), [min(1.0, 4.0 / replicas)] * replicas, sessions=1)
        steps.append(replicas)
    assert steps[-1] == 6
    assert steps == sorted(steps)


def test_nothing_is_taken_away_before_all_have_reported() -> None:
    assert requested(MeasuredLoad(), [0.3], running=2, target=2, sessions=1) == 2
    assert requested(MeasuredLoad(), [], running=1, target=1) == 1
    # The second replica is still loading.
    assert requested(MeasuredLoad(), [1.0], running=1, target=2) == 2


def test_only_an_unused_application_may_have_no_replica() -> None:
    assert requested(MeasuredLoad(), [0.0]) == 0
    assert requested(MeasuredLoad(), [8e-7]) == 0  # the measured utilisation of an idle replica
    assert requested(MeasuredLoad(), [0.0], sessions=1) == 1
    assert requested(MeasuredLoad(), [0.0], requests=1.0) == 1


def test_settings_reach_serve() -> None:
    args = AutoscalingArgs(
        max_replicas=3, target_sessions=8, look_back_s=5, upscale_delay_s=2, downscale_delay_s=4
    )
    config = AutoscalingConfig(**args.options())
    # Sessions are added when all replicas have reported, after one and a half intervals.
    assert (config.max_replicas, config.upscale_delay_s, config.downscale_delay_s) == (3, 1.5, 4)
    assert config.policy.policy_kwargs["busy_s"] == 0.5
    assert (config.look_back_period_s, config.metrics_interval_s) == (5, 1)
    policy: Any = config.policy.get_policy()(**config.policy.policy_kwargs)
    assert requested(policy, [0.1], sessions=9) == 2


@pytest.mark.parametrize(
    "args", [{"target_ongoing_requests": 8}, {"target_utilisation": 1.5}, {"look_back_s": 0}]
)
def test_other_settings_are_refused(args: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        AutoscalingArgs(**args)


def test_the_deployment_of_the_page_about_it_is_accepted() -> None:
    page = Path(__file__).parents[3] / "docs" / "cluster" / "scaling.md"
    [block] = re.findall(r"```yaml\n(applications:.*?)```", page.read_text(), re.DOTALL)
    [application] = yaml.safe_load(block)["applications"]
    args = ServerArgs(**application["args"])
    assert args.autoscaling.min_replicas == 0
