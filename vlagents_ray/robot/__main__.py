"""`python -m vlagents_ray.robot URL`: let a served policy drive a robot, or a simulated one, and say how it went."""

from __future__ import annotations

import argparse
import contextlib
import importlib
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from vlagents_ray.client.agent import RemoteAgent
from vlagents_ray.client.chunks import ChunkPlayer
from vlagents_ray.client.plan import ENSEMBLE, MERGES
from vlagents_ray.errors import ConfigError, VLAgentsError
from vlagents_ray.robot.loop import LoopReport, Robot, run_loop
from vlagents_ray.robot.pacing import empty_loop
from vlagents_ray.robot.record import Recorder
from vlagents_ray.robot.safety import Guard, Watchdog
from vlagents_ray.robot.simulated import SimulatedRobot

_HEADER = ("", "ticks", "missed", "within 2 ms", "p50 ms", "p99 ms", "max ms")


def main(arguments: Sequence[str] | None = None) -> int:
    """Returns the exit status: 0 if every tick had an action of the policy, 1 if not, 2 if it could not run."""
    options = _parser().parse_args(arguments)
    try:
        with _told_to_end():
            report = _run(options)
    except VLAgentsError as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr)  # noqa: T201
        return 2
    return 1 if report.safe_ticks else 0


@contextlib.contextmanager
def _told_to_end() -> Iterator[None]:
    """Let SIGTERM (systemd's) and SIGHUP (a terminal that is closed) end the loop, which stops the robot, as Ctrl-C."""

    def end(number: int, _: object) -> None:
        signal.signal(number, signal.SIG_IGN)  # once is enough: a second one would break the stop off
        sys.exit(128 + number)

    with contextlib.ExitStack() as undo:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGTERM, signal.SIGHUP):
                if signal.getsignal(number) == signal.SIG_DFL:  # nohup ignores it
                    undo.callback(signal.signal, number, signal.signal(number, end))
        yield


def _run(options: argparse.Namespace) -> LoopReport:
    say: Callable[[str], None] = lambda line: print(line, flush=True)  # noqa: E731, T201
    with contextlib.ExitStack() as stack:
        agent = RemoteAgent(
            options.url, transport=options.transport, timeout_s=options.timeout_s
        )  # the player closes it
        agent.initialize()
        contract = agent.contract
        player = stack.enter_context(
            ChunkPlayer(
                agent,
                mode=options.mode,
                execute=options.execute,
                merge=options.merge,
                real_time_chunking=options.rtc,
                deadline_s=options.deadline_ms / 1e3,
                horizon=options.horizon,
                max_age_s=options.max_age_s,
                safe=options.safe,
                check=Guard(contract, max_step=options.max_step),
            )
        )
        robot: Robot = _load(options.robot)() if options.robot else SimulatedRobot(contract)
        recorder = stack.enter_context(Recorder(options.record, options.hz)) if options.record else None
        hangs_s = max(0.2, 5 / options.hz) + options.deadline_ms / 1e3
        watchdog = Watchdog(lambda _: robot.stop(), {"server": options.silent_s, "loop": hangs_s})
        if options.baseline > 0:
            say(_line(_HEADER))
            say(_row("empty loop", empty_loop(options.hz, options.baseline, real_time=options.real_time)))
        report = run_loop(
            robot,
            player,
            hz=options.hz,
            seconds=options.seconds,
            instruction=options.instruction,
            watchdog=watchdog,
            recorder=recorder,
            real_time=options.real_time,
        )
        if options.baseline <= 0:
            say(_line(_HEADER))
        say(_row(f"{options.mode}, {agent.transport}", report.jitter))
        say(
            f"from a tick until its action is applied: p50 {report.work_p50_ms:.2f} ms, p99 {report.work_p99_ms:.2f} ms"
        )
        say(f"ticks without an action of the policy: {report.safe_ticks}")
        for reason, ticks in sorted(report.safe.items(), key=lambda one: -one[1])[:5]:
            say(f"  {ticks} x {reason}")
        for bark in report.barks:
            say(f"watchdog: {bark}")
        say(f"against jitter: {', '.join(report.means)}")
    if recorder is not None:  # closed, so everything is written
        say(f"recorded: {recorder.episodes} episodes in {options.record}, {recorder.dropped} frames dropped")
    return report


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m vlagents_ray.robot", description=__doc__)
    add = parser.add_argument
    add("url", help="the server, as for RemoteAgent: http://gpu-box:8000")
    add("--hz", type=float, default=50.0, help="control rate (%(default)s)")
    add("--seconds", type=float, default=60.0, help="how long (%(default)s)")
    add("--instruction", help="what the robot is told to do")
    add("--robot", metavar="MODULE:CLASS", help="a robot of yours, made without arguments; default: a simulated one")
    add("--mode", choices=("open_loop", "ensemble", "async"), default="async", help="see ChunkPlayer (%(default)s)")
    add("--execute", type=int, metavar="N", help="rows of a chunk to execute before asking again")
    add("--horizon", type=int, metavar="N", help="rows of a chunk that may be executed at all")
    add("--max-age-s", type=float, metavar="S", help="how old the observation behind an action may be")
    add("--merge", choices=(*MERGES, ENSEMBLE), default="newest", help="of chunks that overlap (%(default)s)")
    add("--rtc", action="store_true", help="real-time chunking: send what is left of the plan, and the delay")
    add("--deadline-ms", type=float, default=0.0, help="how long a tick may wait for an action (%(default)s)")
    add("--safe", choices=("auto", "hold", "zero"), default="auto", help="without an action (%(default)s: by contract)")
    add("--max-step", type=float, help="largest change of an action's number from one tick to the next")
    add("--silent-s", type=float, default=2.0, help="stop the robot when the server is silent this long (%(default)s)")
    add("--timeout-s", type=float, default=10.0, help="give a request up after this long (%(default)s)")
    add("--transport", choices=("auto", "shm", "websocket", "http"), default="auto", help="(%(default)s)")
    add("--record", metavar="DIR", help="record a LeRobotDataset v3.0 there; needs the extra 'record'")
    add("--real-time", action="store_true", help="ask for SCHED_FIFO in place of a nice value")
    add("--baseline", type=float, default=5.0, metavar="S", help="first time an empty loop this long (%(default)s)")
    return parser


def _load(name: str) -> Any:
    module, colon, attribute = name.partition(":")
    if not colon:
        raise ConfigError(f"--robot: got {name!r}, want module:Class")
    try:
        return getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        raise ConfigError(f"--robot {name}: {error}; is its folder in PYTHONPATH?") from error


def _row(name: str, jitter: dict[str, float]) -> str:
    numbers = [f"{jitter['ticks']:.0f}", f"{jitter['missed']:.0f}", f"{100 * jitter['on_time']:.2f} %"]
    return _line((name, *numbers, *(f"{jitter[key]:.3f}" for key in ("p50_ms", "p99_ms", "max_ms"))))


def _line(cells: Sequence[str]) -> str:
    return f"{cells[0]:<20}" + "".join(f"{cell:>13}" for cell in cells[1:])


if __name__ == "__main__":
    sys.exit(main())
