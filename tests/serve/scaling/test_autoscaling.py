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
from vlagents_ray.serve.scaling.autoscaling import (
    MOVED_LOAD,
    SESSIONS,
    SLO_LOAD,
    SLO_ROBOTS,
    UTILISATION,
    WAITING,
    MeasuredLoad,
)

POLICY = DeploymentID("Policy", "app")


def context_of(
    utilisation: list[float],
    *,
    waiting: float = 0.0,
    sessions: float = 0.0,
    target: int | None = None,
    running: int | None = None,
    requests: float = 0.0,
    slo_load: float = 0.0,
    moved_load: float = 0.0,
    slo_robots: float = 0.0,
    now: float = 0.0,
    state: dict[str, Any] | None = None,
) -> AutoscalingContext:
    """Return the context that Serve passes to the policy. Each reporting replica has its entry of
    `utilisation`, and the same queue and number of sessions.
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
            WAITING: dict.fromkeys(replicas, waiting),
            SESSIONS: dict.fromkeys(replicas, sessions),
            SLO_LOAD: dict.fromkeys(replicas, slo_load),
            MOVED_LOAD: dict.fromkeys(replicas, moved_load),
            SLO_ROBOTS: dict.fromkeys(replicas, slo_robots),
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


def test_a_long_queue_counts_where_the_policy_is_busy_anyway() -> None:
    assert requested(MeasuredLoad(), [1.0], waiting=3.0) == 3
    assert requested(MeasuredLoad(target_waiting=3.0), [1.0], waiting=3.0) == 2


def test_sessions_count_only_if_a_target_is_set() -> None:
    assert requested(MeasuredLoad(), [0.1], sessions=100, target=1) == 1
    assert requested(MeasuredLoad(target_sessions=32), [0.1], sessions=100) == 4


def test_robots_that_state_their_needs_get_the_replicas_for_them() -> None:
    """Such robots keep replicas busy however few they are, so utilisation says nothing about their
    needs.
    """
    policy = MeasuredLoad()
    assert requested(policy, [1.0], sessions=4, slo_robots=4, slo_load=0.6) == 1
    assert requested(policy, [1.0], sessions=16, slo_robots=16, slo_load=2.1) == 3
    assert requested(policy, [1.0], sessions=2, slo_robots=2, slo_load=9.0) == 2
    assert (
        requested(MeasuredLoad(target_slo_load=0.5), [1.0], sessions=4, slo_robots=4, slo_load=0.6)
        == 2
    )


def test_sessions_that_state_no_needs_count_by_utilisation_as_well() -> None:
    assert requested(MeasuredLoad(), [1.0], sessions=5, slo_robots=4, slo_load=0.6) == 2


def test_measured_load_waits_for_its_delay_and_robots_with_slos_do_not() -> None:
    policy, state = MeasuredLoad(busy_s=7.0), {}
    busy: dict[str, Any] = {"utilisation": [1.0], "sessions": 5.0}

    def at(now: float, **load: Any) -> int:
        nonlocal state
        number, state = policy(context_of(now=now, state=state, **load))
        return number

    assert at(100.0, **busy) == 1
    assert at(106.9, **busy) == 1
    assert at(107.0, **busy) == 2
    assert at(108.0, utilisation=[0.1], sessions=5.0) == 1, "a break"
    assert at(109.0, **busy) == 1
    assert at(110.0, **busy, slo_robots=4, slo_load=2.1) == 3, "one robot declares no needs"
    assert at(116.0, **busy) == 2


def test_sessions_wait_until_all_replicas_have_reported() -> None:
    policy = MeasuredLoad(target_sessions=8, crowded_s=2.0)
    number, state = policy(context_of([0.1], sessions=9.0, now=10.0))
    assert number == 1
    number, state = policy(context_of([0.1], sessions=9.0, now=11.9, state=state))
    assert number == 1
    number, _ = policy(context_of([0.1], sessions=9.0, now=12.0, state=state))
    assert number == 2


def test_robots_that_have_just_moved_request_no_replica_and_keep_theirs() -> None:
    """Two replicas count a robot while it moves, and until Serve has noticed that its replica was
    killed.
    """
    robots: dict[str, Any] = {"sessions": 8.0, "slo_robots": 8.0, "slo_load": 0.8}
    assert requested(MeasuredLoad(), [1.0, 1.0], **robots, moved_load=0.3) == 2
    assert requested(MeasuredLoad(), [1.0, 1.0], **robots) == 2
    robots["slo_load"] = 1.0
    assert requested(MeasuredLoad(), [1.0, 1.0], **robots) == 3
    assert requested(MeasuredLoad(), [1.0, 1.0], **robots, moved_load=0.3) == 2


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
    assert (config.max_replicas, config.upscale_delay_s, config.downscale_delay_s) == (3, 1, 4)
    delays = {name: config.policy.policy_kwargs[name] for name in ("busy_s", "crowded_s")}
    assert delays == {"busy_s": 1.0, "crowded_s": 0.5}
    assert (config.look_back_period_s, config.metrics_interval_s) == (5, 1)
    policy: Any = config.policy.get_policy()(**config.policy.policy_kwargs)
    assert requested(policy, [0.1], slo_load=1.2, slo_robots=9, sessions=9) == 2


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
