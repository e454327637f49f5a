"""Measures the autoscaling of replicas: a timeline of one run on this machine.

An application with `min_replicas` of 0 serves, one after the other, a single robot, a burst of
robots, rollout workers, and a single robot again, with pauses until the last replica has stopped.
The running and the requested replicas and their sessions are sampled throughout; each act is timed
at its client. The policy and the environment sleep, so that four replicas run on few cores.
"""

from __future__ import annotations

import contextlib
import json
import sys
import tempfile
import textwrap
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import typer

from benchmarks.console import Out, save
from benchmarks.environments import ACTION_DIM, SLEEPING_ENV
from benchmarks.line_process import LineProcess, ProcessFailed, our_environment
from benchmarks.picture import OURS, RULE, SERIES, SOFT, new_figure, save_figure
from benchmarks.robots import RobotBurst
from vlagents_ray.cli.console import errors, out, progress, table
from vlagents_ray.client.transports.serve_handle import call_replica
from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate import EvalConfig, PolicyConfig, Results, SuiteConfig, evaluate
from vlagents_ray.registry import require
from vlagents_ray.serve.config.deployment import POLICY
from vlagents_ray.serve.launch.deployment_file import deployment
from vlagents_ray.serve.launch.server import running_server
from vlagents_ray.serve.scaling.sibling_replicas import SiblingApi

_SUFFIXES = (".png", ".svg", ".pdf")
_SESSIONS, _P95 = SERIES[4], SERIES[1]  # colours of the plot
_APP = "noop"
_EVERY_S = 0.5  # time between two samples of the replicas, s
_ANSWER_S = 0.3  # time limit for a replica to report its number of sessions, s
_LATE_S = 180.0  # time by which a burst may exceed its plan, as replicas start, s
_QUIET_S = 180.0
_FROM_NONE = {
    "min_replicas": 0,
    "max_replicas": 4,
    "look_back_s": 4,
    "upscale_delay_s": 2,
    "downscale_delay_s": 6,
}


@dataclass(frozen=True, slots=True)
class AutoscalingPlan:
    """The robots and workers, and the application that serves them."""

    robots: int = 12
    hz: float = 10.0
    workers: int = 8
    seconds: float = 25.0  # duration of a burst, s
    alone_s: float = 5.0  # duration of a phase with a single robot, s
    policy_ms: float = 40.0  # time of a batch, ms
    batch: int = 2  # batch size with which one replica computes 50 actions per second
    step_ms: float = 20.0
    steps: int = 50
    autoscaling: Mapping[str, float] = field(default_factory=_FROM_NONE.copy)


class ScaleSample(NamedTuple):
    """The state of the application at one moment."""

    at: float  # time, s of `time.time()`
    requested: int  # number of requested replicas
    running: int
    sessions: int


class LoadPhase(NamedTuple):
    """A phase in which robots or workers were connected."""

    name: str
    begun: float  # time, s of `time.time()`
    ended: float
    # End, s, and duration, ms, of each call; for rollouts the median of each episode.
    acts: Sequence[tuple[float, float]]
    # Duration of the longest first reset, s; None for rollouts, which connect earlier.
    first_reset_s: float | None
    resumed: int
    failed: Sequence[str]


def measure_autoscaling(
    plan: AutoscalingPlan, progress: Callable[[str], None] = lambda _: None
) -> dict[str, Any]:
    """Run all phases, and return plain JSON values, with times in s since the first robot
    connected.
    """
    served = deployment(
        "noop",
        config={"action_dim": ACTION_DIM, "base_ms": plan.policy_ms},
        batch={"max_size": plan.batch},
        autoscaling=dict(plan.autoscaling),
    )
    with contextlib.ExitStack() as stack:
        server = stack.enter_context(running_server(served, num_cpus=plan.workers + 1))
        top = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        command = [sys.executable, "-m", "benchmarks.robots", server.url]
        robots = stack.enter_context(LineProcess("robots", command, our_environment()))
        robots.read(_LATE_S)
        watcher = stack.enter_context(ScaleWatcher())
        phases = []
        for number, (name, come) in enumerate(_bursts(plan, robots).items()):
            watcher.wait_for_quiet(int(plan.autoscaling.get("min_replicas", 1)))
            progress(f"{name} …")
            phases.append(come(name, top / str(number)))
        watcher.wait_for_quiet(int(plan.autoscaling.get("min_replicas", 1)))
    return report(plan, watcher.samples, phases)


def _bursts(
    plan: AutoscalingPlan, robots: LineProcess
) -> dict[str, Callable[[str, Path], LoadPhase]]:
    def of(number: int, seconds: float) -> Callable[[str, Path], LoadPhase]:
        def come(name: str, _: Path) -> LoadPhase:
            begun = time.time()
            said = robots.request(
                json.dumps({"robots": number, "hz": plan.hz, "seconds": seconds}), seconds + _LATE_S
            )
            return _met(name, begun, [RobotBurst(*one) for one in said])

        return come

    return {
        "first robot": of(1, plan.alone_s),
        f"{plan.robots} robots": of(plan.robots, plan.seconds),
        f"{plan.workers} rollout workers": lambda name, out: _rollouts(plan, name, out),
        "first robot again": of(1, plan.alone_s),
    }


def _met(name: str, begun: float, robots: Sequence[RobotBurst]) -> LoadPhase:
    return LoadPhase(
        name,
        begun,
        time.time(),
        sorted((at, ms) for robot in robots for at, ms in robot.acts),
        max(robot.reset_s for robot in robots),
        sum(robot.resumed for robot in robots),
        [why for robot in robots for why in robot.failed],
    )


def _rollouts(plan: AutoscalingPlan, name: str, out: Path) -> LoadPhase:
    """Run an evaluation of about the plan's `seconds`."""
    begun = time.time()
    episodes = max(1, round(plan.seconds * 1e3 / (plan.steps * (plan.step_ms + plan.policy_ms))))
    config = EvalConfig(
        policies=[PolicyConfig(name="noop", url=f"serve://{_APP}")],
        suites=[
            SuiteConfig(
                envs=[SLEEPING_ENV],
                env_options={"step_ms": plan.step_ms, "max_steps": plan.steps, "size": 64},
                episodes=plan.workers * episodes,
            )
        ],
        workers=plan.workers,
        video="none",
        out=out,
    )
    evaluate(config)
    [case] = Results.load(out).cases
    acts = [
        (one.finished, one.result.policy_ms)
        for one in case.episodes
        if one.result.policy_ms is not None
    ]
    failed = [attempt.error for attempt in case.attempts]
    failed += [
        f"{one.result.key}: {one.result.error}"
        for one in case.episodes
        if one.result.status != "done"
    ]
    return LoadPhase(name, begun, time.time(), sorted(acts), None, 0, failed)


class ScaleWatcher:
    """Samples the application within a context."""

    def __init__(self) -> None:
        self.samples: list[ScaleSample] = []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="autoscaling", daemon=True)

    def __enter__(self) -> ScaleWatcher:
        self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self._stop.set()
        self._thread.join()

    def wait_for_quiet(self, replicas: int) -> None:
        """Wait until no session and at most `replicas` are left. Raises `ProcessFailed` after some
        minutes.
        """
        deadline = time.monotonic() + _QUIET_S
        asked = time.time()
        while not any(
            one.running <= replicas and one.sessions == 0 and one.at > asked
            for one in self.samples[-1:]
        ):
            if time.monotonic() > deadline:
                raise ProcessFailed(
                    f"replicas: {self.samples[-1:]} after {_QUIET_S:g} s without anybody, want "
                    f"{replicas}"
                )
            time.sleep(_EVERY_S)

    def _watch(self) -> None:
        while not self._stop.wait(_EVERY_S):
            self.samples.append(look())


def look() -> ScaleSample:
    """Sample the application. Stopping replicas count as running until their processes end."""
    details = _details(_APP)
    states = [replica["state"] for replica in details["replicas"]]
    running = sum(state in ("RUNNING", "STOPPING") for state in states)
    sessions = sum(_sessions(_running(details)))
    return ScaleSample(time.time(), int(details["target_num_replicas"]), running, sessions)


def sessions_of_replicas(app: str) -> list[int]:
    """Return the number of sessions of each running replica of an application that answers at once,
    the largest first.
    """
    return sorted(_sessions(_running(_details(app))), reverse=True)


def _details(app: str) -> dict[str, Any]:
    """Return Ray Serve's status of the policy's deployment."""
    from ray.serve.context import _get_global_client

    client = _get_global_client()
    details: dict[str, Any] = client.get_serve_details()["applications"][app]["deployments"][POLICY]
    return details


def _running(details: Mapping[str, Any]) -> list[str]:
    """Return the names of the running replicas' actors."""
    return [
        replica["actor_name"] for replica in details["replicas"] if replica["state"] == "RUNNING"
    ]


def _sessions(replicas: Sequence[str]) -> Iterator[int]:
    """Yield the sessions of each replica that answers at once."""
    import ray

    asked = []
    for name in replicas:
        with contextlib.suppress(ValueError):  # the replica has ended
            asked.append(
                call_replica(
                    ray.get_actor(name, namespace="serve"), SiblingApi.peer, "Rebalancer.load"
                )
            )
    ready, _ = ray.wait(asked, num_returns=len(asked), timeout=_ANSWER_S) if asked else ([], [])
    for reference in ready:
        with contextlib.suppress(ray.exceptions.RayError):
            yield ray.get(reference).sessions


def report(
    plan: AutoscalingPlan, samples: Sequence[ScaleSample], phases: Sequence[LoadPhase]
) -> dict[str, Any]:
    """Return all figures as plain JSON values."""
    begun = phases[0].begun
    return {
        "plan": asdict(plan),
        "samples": [one._replace(at=one.at - begun)._asdict() for one in samples],
        "phases": [
            one._asdict()
            | {"begun": one.begun - begun, "ended": one.ended - begun, "failed": list(one.failed)}
            | {
                "acts": len(one.acts),
                "most_replicas": _most(samples, one),
                "seconds": by_second(one.acts, begun),
            }
            | dict(
                zip(
                    ("median_ms", "p95_ms", "longest_ms"),
                    _quantiles([ms for _, ms in one.acts]),
                    strict=True,
                )
            )
            for one in phases
        ],
    }


def by_second(acts: Sequence[tuple[float, float]], begun: float) -> list[dict[str, float]]:
    """Return the median and the 95 % quantile of the calls in each second, by the middle of the
    second.
    """
    durations_ms: dict[int, list[float]] = {}
    for at, ms in acts:
        durations_ms.setdefault(int((at - begun) // 1), []).append(ms)
    quantiles = {second: _quantiles(each) for second, each in sorted(durations_ms.items())}
    return [
        {"at": second + 0.5, "median_ms": one[0], "p95_ms": one[1]}
        for second, one in quantiles.items()
    ]


def _quantiles(values: Sequence[float]) -> list[float]:
    return (
        [float(one) for one in np.quantile(values, (0.5, 0.95, 1.0))]
        if values
        else [float("nan")] * 3
    )


def _most(samples: Sequence[ScaleSample], phase: LoadPhase) -> int:
    return max((one.running for one in samples if phase.begun <= one.at <= phase.ended), default=0)


def check_plot_file(file: Path | None) -> None:
    """Raise `ConfigError` if the suffix is not .png, .svg or .pdf, and `MissingDependency` if
    matplotlib is not installed.
    """
    if file is None:
        return
    if file.suffix not in _SUFFIXES:
        raise ConfigError(
            f"--plot: expected a name that ends in one of {list(_SUFFIXES)}, got {file.name!r}"
        )
    require("matplotlib")


def plot_autoscaling(measured: Mapping[str, Any], file: Path) -> None:
    """Draw replicas and sessions over time, and below them the latency of calls."""
    with new_figure(6.0) as figure:
        sessions, replicas, latency = figure.subplots(
            3, 1, sharex=True, height_ratios=[1.4, 1.5, 2]
        )
        times = [sample["at"] for sample in measured["samples"]]
        sessions.fill_between(
            times,
            [sample["sessions"] for sample in measured["samples"]],
            step="post",
            color=_SESSIONS,
            alpha=0.6,
            lw=0,
        )
        sessions.set_title("Sessions")
        for name, colour, style, label in (
            ("requested", SOFT, "--", "target"),
            ("running", OURS, "-", "running"),
        ):
            numbers = [sample[name] for sample in measured["samples"]]
            replicas.step(times, numbers, style, where="post", color=colour, label=label)
        replicas.set_title("Replicas")
        replicas.legend(loc="upper left", frameon=False, labelcolor="linecolor")
        for phase in measured["phases"]:
            at = [second["at"] for second in phase["seconds"]]
            medians = [second["median_ms"] for second in phase["seconds"]]
            latency.plot(at, medians, "-", color=OURS, lw=2)
            p95 = [second["p95_ms"] for second in phase["seconds"]]
            latency.plot(at, p95, ".", color=_P95, ms=4)
            for axes in (sessions, replicas, latency):
                axes.axvspan(phase["begun"], phase["ended"], color=RULE, alpha=0.35, lw=0)
            sessions.annotate(
                _phase_text(phase),
                (phase["begun"], 1.0),
                xytext=(2, -2),
                xycoords=("data", "axes fraction"),
                textcoords="offset points",
                va="top",
            )
        highest_ms = 0.0
        for phase in measured["phases"]:
            for second in phase["seconds"]:
                highest_ms = max(highest_ms, second["p95_ms"])
        latency.set_ylim(0, 1.1 * highest_ms)
        latency.set_title("Latency per call, ms (line: median, dots: 95th percentile)")
        latency.set_xlabel("time since the first robot connected, s")
        most = max(sample["sessions"] for sample in measured["samples"])
        sessions.set_ylim(0, 2.4 * max(1, most))  # space for the names of the phases
        for axes in (sessions, replicas):
            axes.yaxis.get_major_locator().set_params(integer=True)
        save_figure(figure, file)


def _phase_text(phase: Mapping[str, Any]) -> str:
    """Return the name of a phase, in lines that fit the width of the phase's shade."""
    text = textwrap.fill(str(phase["name"]), 10)
    if phase["failed"]:
        text += f"\n{len(phase['failed'])} failed"
    return text


def show_autoscaling(measured: Mapping[str, Any]) -> None:
    """Print a row for each phase."""
    rows = table(
        "",
        "first reset s",
        "replicas",
        "acts",
        "failed",
        "begun again",
        "median ms",
        "p95 ms",
        "longest",
    )
    for one in measured["phases"]:
        waited = "" if one["first_reset_s"] is None else f"{one['first_reset_s']:.1f}"
        rows.add_row(
            one["name"],
            waited,
            str(one["most_replicas"]),
            str(one["acts"]),
            str(len(one["failed"])),
            str(one["resumed"]),
            *(f"{one[key]:.1f}" for key in ("median_ms", "p95_ms", "longest_ms")),
        )
    out.print(rows)


def main(
    robots: Annotated[int, typer.Option(min=1, help="Number of robots that come at once.")] = 12,
    workers: Annotated[
        int, typer.Option(min=1, help="Number of workers of the evaluation that follows.")
    ] = 8,
    seconds: Annotated[
        float,
        typer.Option(min=1, help="Approximate duration of each of the two phases, in seconds."),
    ] = 25.0,
    out_file: Out = None,
    plot: Annotated[
        Path | None, typer.Option("--plot", help="File for the picture: .png, .svg or .pdf.")
    ] = None,
) -> None:
    """Measure replicas over time while robots and rollouts start and end, from no replica and
    back to none.
    """
    with errors():
        check_plot_file(plot)
        measured = measure_autoscaling(
            AutoscalingPlan(robots=robots, workers=workers, seconds=seconds), progress
        )
        show_autoscaling(measured)
        save(measured, out_file)
        if plot is not None:
            plot_autoscaling(measured, plot)
            out.print(f"wrote {plot}")


if __name__ == "__main__":
    typer.run(main)
