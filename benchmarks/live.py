"""Measures the cost of the live page: calls of robots with no, one and four viewers, alternating in
one run.

One cluster serves three applications, each with one replica of a policy that takes 5 ms: one
unchanged, one whose sender lacks the lines for the live page, and one that keeps the last 30 s of
each session. All applications serve the same robots: two with 50 Hz, and a saturated robot that
sends its next request at each answer. Robots and viewers have separate processes. The settings
alternate within each round. A viewer shows the pictures of all sessions, and requests the next
message immediately, like the page. On a busy machine the CPU time of the replica is a better
measure than actions per second.
"""

from __future__ import annotations

import contextlib
import inspect
import json
import os
import re
import statistics
import sys
import tempfile
import textwrap
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from types import FunctionType
from typing import Annotated, Any, NamedTuple

import numpy as np
import typer
from websockets.sync.client import connect

from benchmarks.console import Out, save
from benchmarks.drivers import START_S
from benchmarks.line_process import LineProcess, our_environment
from benchmarks.own_clients import observation
from benchmarks.processes import cpu_seconds
from vlagents_ray.cli.console import errors, out, progress, table
from vlagents_ray.client.agent import RemoteAgent
from vlagents_ray.client.transports.select import TransportName
from vlagents_ray.errors import ConfigError
from vlagents_ray.interface import Obs
from vlagents_ray.policies.noop import Noop
from vlagents_ray.serve.engine import sender
from vlagents_ray.serve.launch.deployment_file import deployment
from vlagents_ray.serve.launch.server import running_server
from vlagents_ray.serve.python_env.child_start import die_with_parent, own_stdout
from vlagents_ray_live.live import LEASE_S

ABSENT, NOBODY, RING = "tap absent", "nobody", "nobody, 30 s held"
HZ, SATURATED_HZ = 50.0, 1e9
_CHUNK = 8
_CONFIG = {"base_ms": 5.0, "action_dim": 7, "chunk": _CHUNK}
_WARM_S = 0.5
_LEASE_ENDS_S = LEASE_S + 1.0  # time after which the lease of the last viewer has ended, s


class Measured(Noop):
    """`noop` that returns the id of its process."""

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        """Return the id of the replica's process."""
        return super().reset(obs, instruction, **kwargs) | {"pid": os.getpid()}


class Untapped(Measured):
    """`noop` in a replica whose senders were compiled without the lines for the live page."""

    def initialize(self) -> None:
        """Replace the code of this process."""
        super().initialize()
        functions: list[Any] = [sender.Sender.send, sender.message_admission]
        for function in functions:
            _without(function, r"engine\.observers\.any", "False")


def _without(function: FunctionType, lines: str, instead: str) -> None:
    """Compile a function of the sender's module again, after replacing the only lines
    that match.
    """
    source, found_lines = re.subn(lines, instead, textwrap.dedent(inspect.getsource(function)))
    if found_lines != 1:
        raise ConfigError(
            f"{function.__name__}: expected 1, got {found_lines} places with the lines for the "
            "tap; look there"
        )
    found: dict[str, Any] = {}
    exec(source, vars(sender), found)  # noqa: S102 - the package's own source
    # Other modules have imported the function.
    function.__code__ = found[function.__name__].__code__


class Turn(NamedTuple):
    """The robots' figures for one turn of one setting."""

    acts_per_s: float  # actions per second of the saturated robot
    cpu_ms: float  # CPU time of the replica's process per action of any robot, ms
    saturated_ms: list[float]
    paced_ms: list[float]  # durations of the calls of the robots with 50 Hz, ms
    messages_per_s: float  # messages per second to all viewers
    mb_per_s: float


class Robots:
    """The robots of one application: a process with the robots that have a rate, and a process with
    the saturated robot.
    """

    def __init__(self, stack: contextlib.ExitStack, name: str, url: str, transport: str) -> None:
        self._processes = [
            stack.enter_context(
                _process(f"{kind} of {name}", {"url": url, "hz": hz, "transport": transport})
            )
            for kind, hz in (("robots", [HZ, HZ]), ("saturated robot", [SATURATED_HZ]))
        ]
        # process id of the replica
        [self.replica] = {process.read(START_S) for process in self._processes}

    def act(self, seconds: float) -> list[list[float]]:
        """Run all robots, and return the durations of the calls of the paced robots and of the
        saturated robot, ms.
        """
        for process in self._processes:
            process.send(json.dumps(seconds))
        return [process.read(seconds + START_S) for process in self._processes]


def measure_live(
    rounds: int,
    seconds: float,
    viewers: Sequence[int],
    transport: TransportName,
    progress: Callable[[str], None] = lambda _: None,
) -> dict[str, Any]:
    """Measure each setting once in each round, for `seconds`, and return plain JSON values."""
    turns: dict[str, list[Turn]] = {}
    with contextlib.ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory())
        made = {
            "tapped": deployment("benchmarks.live:Measured", config=_CONFIG),
            "untapped": deployment("benchmarks.live:Untapped", config=_CONFIG),
            "holding": deployment(
                "benchmarks.live:Measured", config=_CONFIG, parts={"live": {"folder": folder}}
            ),
        }
        apps = [one.applications[0] for one in made.values()]
        for name, one in zip(made, apps, strict=True):
            one.name, one.route_prefix = name, f"/{name}"
        server = stack.enter_context(
            running_server(made["tapped"].model_copy(update={"applications": apps}))
        )
        fleets = {
            app.name: Robots(stack, app.name, server.apps[app.name], transport) for app in apps
        }
        watching = [
            stack.enter_context(_process(f"viewer {number}", {"watch": server.apps["tapped"]}))
            for number in range(max(viewers, default=0))
        ]
        extensions = {str(one.read(START_S)) for one in watching}
        settings = [(ABSENT, "untapped", 0), (NOBODY, "tapped", 0), (RING, "holding", 0)]
        settings += [(_name(n), "tapped", n) for n in viewers]
        for number in range(rounds):
            shift = number % len(settings)  # rotates the settings, so that none is always first
            for name, app, looking in settings[shift:] + settings[:shift]:
                if name == NOBODY:
                    time.sleep(_LEASE_ENDS_S)
                turns.setdefault(name, []).append(_turn(fleets[app], watching[:looking], seconds))
            progress(
                f"round {number + 1}/{rounds}: "
                + ", ".join(f"{name} {turns[name][-1].acts_per_s:.0f}/s" for name, *_ in settings)
            )
    return {
        "transport": transport,
        "rounds": rounds,
        "seconds": seconds,
        "websocket_extensions": sorted(extensions),
        "settings": {name: _figures(turns[name], turns[_base(name)]) for name, *_ in settings},
    }


def _name(viewers: int) -> str:
    return f"{viewers} viewer{'s' * (viewers != 1)}"


def _base(name: str) -> str:
    """Return the setting with which a setting is compared: the build without live page, or the same
    build without viewers.
    """
    return ABSENT if name in (ABSENT, NOBODY) else NOBODY


def _turn(robots: Robots, watching: Sequence[LineProcess], seconds: float) -> Turn:
    for viewer in watching:
        viewer.send(json.dumps(seconds + 2 * _WARM_S))
    time.sleep(_WARM_S)
    before = cpu_seconds(robots.replica)
    paced, saturated = robots.act(seconds)
    cpu_ms = 1e3 * (cpu_seconds(robots.replica) - before) / (len(paced) + len(saturated))
    seen = [viewer.read(seconds + START_S) for viewer in watching]
    messages, size = (sum(one[i] for one in seen) / (seconds + 2 * _WARM_S) for i in (0, 1))
    return Turn(len(saturated) / seconds, cpu_ms, saturated, paced, messages, size / 1e6)


def _figures(turns: list[Turn], base: list[Turn]) -> dict[str, Any]:
    ratios = [mine.acts_per_s / theirs.acts_per_s for mine, theirs in zip(turns, base, strict=True)]
    found = {
        "acts_per_s": statistics.median(turn.acts_per_s for turn in turns),
        "cpu_ms_per_act": statistics.median(turn.cpu_ms for turn in turns),
        "ratios": ratios,
        "median_ratio": statistics.median(ratios),
        "messages_per_s": statistics.median(turn.messages_per_s for turn in turns),
        "mb_per_s": statistics.median(turn.mb_per_s for turn in turns),
    }
    for name in ("paced_ms", "saturated_ms"):
        values = np.concatenate([getattr(turn, name) for turn in turns])
        found |= {
            f"{name}_p50": float(np.quantile(values, 0.5)),
            f"{name}_p99": float(np.quantile(values, 0.99)),
        }
    return found


@contextlib.contextmanager
def _process(name: str, settings: dict[str, Any]) -> Iterator[LineProcess]:
    command = [sys.executable, "-m", "benchmarks.live", json.dumps(settings)]
    with LineProcess(name, command, our_environment()) as process:
        yield process


def child(settings: dict[str, Any]) -> None:
    """Run a process of robots or of a viewer; each line on its standard input is the length of a
    turn, s.
    """
    die_with_parent()
    file = own_stdout()
    with contextlib.ExitStack() as stack:
        act, said = (_viewer if "watch" in settings else _robots)(stack, **settings)
        print(json.dumps(said), file=file, flush=True)
        for line in sys.stdin:
            print(json.dumps(act(float(line))), file=file, flush=True)


def _robots(
    stack: contextlib.ExitStack, url: str, hz: Sequence[float], transport: TransportName
) -> tuple[Callable[[float], list[float]], int]:
    agents = [stack.enter_context(RemoteAgent(url, transport=transport, codec="jpeg")) for _ in hz]
    pool = stack.enter_context(ThreadPoolExecutor(len(hz)))
    replica, *_ = [agent.reset(observation(), "measure")["pid"] for agent in agents]

    def play(agent: RemoteAgent, hz: float, seconds: float) -> list[float]:
        taken: list[float] = []
        begun = tick = time.monotonic()
        while (now := time.monotonic()) < begun + seconds:
            agent.act(observation())
            taken.append((time.monotonic() - now) * 1e3)
            tick = max(tick + 1 / hz, time.monotonic())
            time.sleep(max(0.0, tick - time.monotonic()))
        return taken

    def act(seconds: float) -> list[float]:
        played = [
            pool.submit(play, agent, each, seconds) for agent, each in zip(agents, hz, strict=True)
        ]
        return [ms for one in played for ms in one.result()]

    return act, replica


def _viewer(_: contextlib.ExitStack, watch: str) -> tuple[Callable[[float], tuple[int, int]], str]:
    """Connect as a browser does, which offers to compress messages."""
    address = f"{watch.replace('http', 'ws', 1)}/v1/live"
    with connect(address, proxy=None, max_size=None) as socket:
        said = (
            socket.response.headers.get("sec-websocket-extensions", "") if socket.response else ""
        )

    def look(seconds: float) -> tuple[int, int]:
        messages = size = 0
        shown: list[str] = []
        until = time.monotonic() + seconds
        with connect(address, proxy=None, max_size=None) as socket:
            while time.monotonic() < until:
                socket.send(json.dumps({"shown": shown}))
                data = socket.recv()
                messages, size = messages + 1, size + len(data)
                document = json.loads(bytes(data[4 : 4 + int.from_bytes(data[:4], "little")]))  # type: ignore[arg-type]
                shown = [
                    one["id"] for replica in document["replicas"] for one in replica["sessions"]
                ]
        return messages, size

    return look, said


def main(
    rounds: Annotated[int, typer.Option(min=1, help="Number of turns of each setting.")] = 8,
    seconds: Annotated[float, typer.Option(help="Length of a turn, s.")] = 5.0,
    viewers: Annotated[
        list[int], typer.Option(help="Number of simultaneous viewers; may be repeated.")
    ] = [1, 4],  # noqa: B006
    transport: Annotated[str, typer.Option(help="Transport of the robots.")] = "websocket",
    out_file: Out = None,
) -> None:
    """Measure the cost of the live page for robots, with no, one and four viewers."""
    with errors():
        found = measure_live(rounds, seconds, viewers, transport, progress)  # type: ignore[arg-type]
    rows = [
        [
            name,
            f"{one['acts_per_s']:.1f}",
            f"{one['median_ratio']:.3f} ({min(one['ratios']):.3f} to {max(one['ratios']):.3f})",
            f"{one['cpu_ms_per_act']:.2f}",
            f"{one['paced_ms_p50']:.1f} / {one['paced_ms_p99']:.1f}",
            f"{one['saturated_ms_p50']:.1f} / {one['saturated_ms_p99']:.1f}",
            f"{one['messages_per_s']:.1f}",
            f"{one['mb_per_s']:.2f}",
        ]
        for name, one in found["settings"].items()
    ]
    columns = (
        "acts/s",
        "ratio",
        "CPU ms/act",
        "50 Hz p50/p99 ms",
        "saturated p50/p99 ms",
        "messages/s",
        "MB/s",
    )
    shown = table("who looks", *columns)
    for row in rows:
        shown.add_row(*row)
    out.print(shown)
    out.print(
        "compression of the viewers' messages: "
        f"{', '.join(found['websocket_extensions']) or 'none'}"
    )
    save(found, out_file)


if __name__ == "__main__":
    if len(sys.argv) == 2 and sys.argv[1].startswith("{"):
        child(json.loads(sys.argv[1]))
    else:
        typer.run(main)
