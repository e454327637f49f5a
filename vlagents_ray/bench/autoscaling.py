"""Replicas that come with the load and go with it: a timeline of one run on this machine.

An application that may have no replica at all meets, one after the other: a single robot, a burst of robots, rollout
workers, and a single robot again, with quiet in between until the last replica is gone. All the while it is noted how
many replicas there are and are wanted, and how many sessions they hold; each act is timed where it was asked for.
The policy and the environment sleep, so that four replicas run on few cores.
"""

from __future__ import annotations

import contextlib
import json
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from vlagents_ray.bench.child import Child, ChildFailed
from vlagents_ray.bench.robots import Met
from vlagents_ray.bench.slept import ACTION_DIM, SLEPT
from vlagents_ray.bench.ways import our_environment
from vlagents_ray.client.handle import call_replica
from vlagents_ray.evaluate import EvalConfig, PolicyConfig, Results, SuiteConfig, evaluate
from vlagents_ray.serve.cluster import running_server
from vlagents_ray.serve.config import POLICY
from vlagents_ray.serve.files import deployment

_APP = "noop"
_EVERY_S = 0.5  # between two looks at the replicas
_ANSWER_S = 0.3  # that a replica may take to say how many sessions it holds
_LATE_S = 180.0  # that a burst may take longer than planned: replicas start
_QUIET_S = 180.0
_FROM_NONE = {"min_replicas": 0, "max_replicas": 4, "look_back_s": 4, "upscale_delay_s": 2, "downscale_delay_s": 6}


@dataclass(frozen=True, slots=True)
class AutoscalingPlan:
    """Who comes, and what they come to."""

    robots: int = 12
    hz: float = 10.0
    workers: int = 8
    seconds: float = 25.0  # of a burst
    alone_s: float = 5.0  # of a single robot
    policy_ms: float = 40.0  # of a batch
    batch: int = 2  # so that one replica gives 50 actions a second
    step_ms: float = 20.0
    steps: int = 50
    autoscaling: Mapping[str, float] = field(default_factory=_FROM_NONE.copy)


class Sample(NamedTuple):
    """The application at one moment."""

    at: float  # s of `time.time()`
    wanted: int  # replicas
    running: int
    sessions: int


class Phase(NamedTuple):
    """Somebody was there."""

    name: str
    begun: float  # s of `time.time()`
    ended: float
    acts: Sequence[tuple[float, float]]  # s, ms; of rollouts an episode's median
    first_reset_s: float | None  # of the robot that waited longest; rollouts connect before
    resumed: int
    failed: Sequence[str]


def measure_autoscaling(plan: AutoscalingPlan, tell: Callable[[str], None] = lambda _: None) -> dict[str, Any]:
    """As plain JSON values; times are s since the first robot came."""
    served = deployment(
        "noop",
        config={"action_dim": ACTION_DIM, "base_ms": plan.policy_ms},
        batch={"max_size": plan.batch},
        autoscaling=dict(plan.autoscaling),
    )
    with contextlib.ExitStack() as stack:
        server = stack.enter_context(running_server(served, num_cpus=plan.workers + 1))
        top = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        command = [sys.executable, "-m", "vlagents_ray.bench.robots", server.url]
        robots = stack.enter_context(Child("robots", command, our_environment()))
        robots.hear(_LATE_S)
        watcher = stack.enter_context(Watcher())
        phases = []
        for number, (name, come) in enumerate(_bursts(plan, robots).items()):
            watcher.wait_for_quiet(int(plan.autoscaling.get("min_replicas", 1)))
            tell(f"{name} …")
            phases.append(come(name, top / str(number)))
        watcher.wait_for_quiet(int(plan.autoscaling.get("min_replicas", 1)))
    return report(plan, watcher.samples, phases)


def _bursts(plan: AutoscalingPlan, robots: Child) -> dict[str, Callable[[str, Path], Phase]]:
    def of(number: int, seconds: float) -> Callable[[str, Path], Phase]:
        def come(name: str, _: Path) -> Phase:
            begun = time.time()
            said = robots.ask(json.dumps({"robots": number, "hz": plan.hz, "seconds": seconds}), seconds + _LATE_S)
            return _met(name, begun, [Met(*one) for one in said])

        return come

    return {
        "first robot": of(1, plan.alone_s),
        f"{plan.robots} robots": of(plan.robots, plan.seconds),
        f"{plan.workers} rollout workers": lambda name, out: _rollouts(plan, name, out),
        "first robot again": of(1, plan.alone_s),
    }


def _met(name: str, begun: float, robots: Sequence[Met]) -> Phase:
    return Phase(
        name,
        begun,
        time.time(),
        sorted((at, ms) for robot in robots for at, ms in robot.acts),
        max(robot.reset_s for robot in robots),
        sum(robot.resumed for robot in robots),
        [why for robot in robots for why in robot.failed],
    )


def _rollouts(plan: AutoscalingPlan, name: str, out: Path) -> Phase:
    """An evaluation of about so many seconds."""
    begun = time.time()
    episodes = max(1, round(plan.seconds * 1e3 / (plan.steps * (plan.step_ms + plan.policy_ms))))
    config = EvalConfig(
        policies=[PolicyConfig(name="noop", url=f"serve://{_APP}")],
        suites=[
            SuiteConfig(
                envs=[SLEPT],
                env_options={"step_ms": plan.step_ms, "max_steps": plan.steps, "size": 64},
                episodes=plan.workers * episodes,
            )
        ],
        workers=plan.workers,
        video="none",
        out=out,
    )
    evaluate(config)
    [cell] = Results.load(out).cells
    acts = [(one.finished, one.result.policy_ms) for one in cell.episodes if one.result.policy_ms is not None]
    failed = [attempt.error for attempt in cell.attempts]
    failed += [f"{one.result.key}: {one.result.error}" for one in cell.episodes if one.result.status != "done"]
    return Phase(name, begun, time.time(), sorted(acts), None, 0, failed)


class Watcher:
    """Looks at the application until it is left. Use as a context manager."""

    def __init__(self) -> None:
        self.samples: list[Sample] = []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="autoscaling", daemon=True)

    def __enter__(self) -> Watcher:
        self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self._stop.set()
        self._thread.join()

    def wait_for_quiet(self, replicas: int) -> None:
        """Until nobody is there, and only so many replicas are left. Raises `ChildFailed` if that takes too long."""
        deadline = time.monotonic() + _QUIET_S
        asked = time.time()
        while not any(one.running <= replicas and one.sessions == 0 and one.at > asked for one in self.samples[-1:]):
            if time.monotonic() > deadline:
                raise ChildFailed(
                    f"replicas: {self.samples[-1:]} after {_QUIET_S:g} s without anybody, want {replicas}"
                )
            time.sleep(_EVERY_S)

    def _watch(self) -> None:
        while not self._stop.wait(_EVERY_S):
            self.samples.append(look())


def look() -> Sample:
    """At the application, now. Replicas that stop count as running as long as they live."""
    from ray.serve.context import _get_global_client

    client = _get_global_client()
    details = client.get_serve_details()["applications"][_APP]["deployments"][POLICY]
    names = {one["actor_name"]: one["state"] for one in details["replicas"]}
    running = sum(state in ("RUNNING", "STOPPING") for state in names.values())
    sessions = sum(_sessions([name for name, state in names.items() if state == "RUNNING"]))
    return Sample(time.time(), int(details["target_num_replicas"]), running, sessions)


def _sessions(replicas: Sequence[str]) -> Iterator[int]:
    """What each of those holds that answer at once."""
    import ray

    asked = []
    for name in replicas:
        with contextlib.suppress(ValueError):  # it ended meanwhile
            asked.append(call_replica(ray.get_actor(name, namespace="serve"), "load"))
    ready, _ = ray.wait(asked, num_returns=len(asked), timeout=_ANSWER_S) if asked else ([], [])
    for reference in ready:
        with contextlib.suppress(ray.exceptions.RayError):
            yield ray.get(reference).sessions


def report(plan: AutoscalingPlan, samples: Sequence[Sample], phases: Sequence[Phase]) -> dict[str, Any]:
    """What came of it."""
    begun = phases[0].begun
    return {
        "plan": asdict(plan),
        "samples": [one._replace(at=one.at - begun)._asdict() for one in samples],
        "phases": [
            one._asdict()
            | {"begun": one.begun - begun, "ended": one.ended - begun, "failed": list(one.failed)}
            | {"acts": len(one.acts), "most_replicas": _most(samples, one), "seconds": by_second(one.acts, begun)}
            | dict(zip(("median_ms", "p95_ms", "longest_ms"), _quantiles([ms for _, ms in one.acts]), strict=True))
            for one in phases
        ],
    }


def by_second(acts: Sequence[tuple[float, float]], begun: float) -> list[dict[str, float]]:
    """Median and 95 % quantile of what was answered within each second, by its middle."""
    found: dict[int, list[float]] = {}
    for at, ms in acts:
        found.setdefault(int((at - begun) // 1), []).append(ms)
    quantiles = {second: _quantiles(each) for second, each in sorted(found.items())}
    return [{"at": second + 0.5, "median_ms": one[0], "p95_ms": one[1]} for second, one in quantiles.items()]


def _quantiles(values: Sequence[float]) -> list[float]:
    return [float(one) for one in np.quantile(values, (0.5, 0.95, 1.0))] if values else [float("nan")] * 3


def _most(samples: Sequence[Sample], phase: Phase) -> int:
    return max((one.running for one in samples if phase.begun <= one.at <= phase.ended), default=0)
