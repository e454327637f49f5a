"""Counts the calls of Python, the system calls and the context switches of one warm inference call,
in client and server, for each transport.

Unlike times, these counts hardly depend on the machine and its load. Waiting does not count, as the
number of polls depends on the time that the other side needs. System calls are counted by `strace`,
if it is installed.
"""

from __future__ import annotations

import asyncio
import contextlib
import gc
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import threading
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import FrameType
from typing import Annotated, Any

import typer

from benchmarks.console import Out, Transports, save, show_skipped
from benchmarks.figures import measured_on
from benchmarks.own_clients import OwnClient, connect, observation, own_clients
from vlagents_ray.cli.console import errors, out, table
from vlagents_ray.cli.options import parse_list
from vlagents_ray.client.agent import RemoteAgent
from vlagents_ray.interface import Obs
from vlagents_ray.policies.noop import Noop
from vlagents_ray.serve.launch.deployment_file import deployment
from vlagents_ray.serve.launch.server import running_server

POLICY = "benchmarks.calls:CountedNoop"
WARM_UP = 50  # number of calls before counting
_WAITING = {
    "_wait_for_request",
    "_wait_for_event",
    "poll",
    "mark_idle",
    "mark_busy",
    "await_answer",
}
_WAITING_CALLS = {
    "clock_nanosleep",
    "epoll_pwait",
    "epoll_wait",
    "futex",
    "poll",
    "restart_syscall",
    "sched_yield",
}
_OFTEN = 0.5  # minimum number of calls per act; rarer calls belong to other threads
Counts = dict[str, float]


class CallCounter:
    """Counts the calls on the threads on which it is installed."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()
        self._thread = 0

    def install(self) -> None:
        """Count on this thread, on threads that start later, and on the threads of this process's
        event loops.
        """
        threading.setprofile(self.count)
        sys.setprofile(self.count)
        for one in gc.get_objects():
            if isinstance(one, asyncio.AbstractEventLoop) and one.is_running():
                one.call_soon_threadsafe(sys.setprofile, self.count)

    def count(self, frame: FrameType, event: str, _: Any) -> None:
        """Count an event of Python's profiler."""
        if event in ("call", "c_call") and frame.f_code.co_name not in _WAITING:
            self._counts["Python" if event == "call" else "C"] += 1
            if self._thread != (thread := threading.get_ident()):
                self._thread = thread
                self._counts["hand-overs"] += 1

    def read(self) -> Counts:
        """Return the counts so far, and the kernel's counts for this process."""
        used = resource.getrusage(resource.RUSAGE_SELF)
        return {"Python": 0, "C": 0, "hand-overs": 0, **self._counts, "switches": used.ru_nvcsw}


class CountedNoop(Noop):
    """The policy whose acts are counted: `reset` returns the counts of its process."""

    counter = CallCounter()

    def initialize(self) -> None:
        self.counter.install()

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        return {"pid": os.getpid(), **self.counter.read()}


def counted(agent: RemoteAgent, obs: Obs, acts: int) -> dict[str, Counts]:
    """Return the counts of one call for the "client" and for the "server", whose policy is
    `CountedNoop`.
    """
    counter = CallCounter()
    begun = agent.reset(obs)
    for _ in range(WARM_UP):
        agent.act(obs)
    # The second run has twice as many calls, so that the difference does not contain the reset.
    snapshots = [agent.reset(obs)]
    for number in (acts, 2 * acts):
        before = counter.read()
        sys.setprofile(counter.count)
        for _ in range(number):
            agent.act(obs)
        sys.setprofile(None)
        client = {name: (value - before[name]) / number for name, value in counter.read().items()}
        snapshots.append(agent.reset(obs))
    first, second, third = snapshots
    server = {name: (third[name] - 2 * second[name] + first[name]) / acts for name in client}
    for counts, target in (
        (client, ["-p", str(threading.get_native_id())]),
        (server, ["-f", "-p", str(begun["pid"])]),
    ):
        if shutil.which("strace") is not None:
            with traced(target) as calls:
                for _ in range(acts):
                    agent.act(obs)
            often = {name: count / acts for name, count in calls.items() if count / acts > _OFTEN}
            counts |= {
                "system": sum(often.values()),
                **{f"system: {name}": count for name, count in often.items()},
            }
    return {"client": client, "server": server}


@contextlib.contextmanager
def traced(target: Sequence[str]) -> Iterator[Counter[str]]:
    """Count the system calls of a process or thread within the context, except those that wait; the
    result is yielded.
    """
    calls: Counter[str] = Counter()
    with tempfile.NamedTemporaryFile("r") as summary:
        command = ["strace", "-c", "-U", "calls,name", "-o", summary.name, *target]
        with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as strace:
            if strace.stderr is not None:
                strace.stderr.readline()  # strace has attached
            yield calls
            strace.terminate()
        for words in map(str.split, Path(summary.name).read_text().splitlines()):
            if (
                len(words) == 2
                and words[0].isdecimal()
                and words[1] not in {"total", *_WAITING_CALLS}
            ):
                calls[words[1]] += int(words[0])


def count_acts(own: Sequence[OwnClient], acts: int) -> list[dict[str, Any]]:
    """Return the counts of each client, which runs in this process, and of a replica."""
    found = []
    with running_server(deployment(POLICY)) as server:
        [(app, url)] = server.apps.items()
        for one in own:
            agent = connect(f"serve://{app}" if one.actor else url, one.transport, one.codec)
            with agent:
                found.append(
                    {
                        "way": one.name.removesuffix(", Ray actor"),
                        **counted(agent, observation(), acts),
                    }
                )
    return found


def main(
    acts: Annotated[int, typer.Option(min=1, help="Number of calls that are counted.")] = 200,
    transports: Transports = "",
    out_file: Out = None,
) -> None:
    """Count the calls of Python and C, the system calls and the context switches of one inference
    call, for each transport.
    """
    with errors():
        own, skipped = own_clients(parse_list(transports))
        own = [one for one in own if one.actor is (one.transport in ("plasma", "handle"))]
        found = {
            **measured_on("python -m benchmarks.calls"),
            "ways": count_acts(own, acts),
            "skipped": skipped,
        }
        names = ("Python", "C", "system", "switches", "hand-overs")
        rows = table("way", "side", *names)
        for way in found["ways"]:
            for side in ("client", "server"):
                rows.add_row(
                    way["way"],
                    side,
                    *(f"{way[side].get(name, float('nan')):.1f}" for name in names),
                )
        out.print(rows)
        show_skipped(found)
        save(found, out_file)


if __name__ == "__main__":
    typer.run(main)
