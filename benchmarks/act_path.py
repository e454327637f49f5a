"""The files of this project that one warm act enters, in order, by transport, of client and server;
beside them its calls of Python and C, and its system calls, as `benchmarks.calls` counts them.

A file counts if most of the acts enter it, on any thread: a thread that wakes up by chance during
one of them does not add its files. How much a reader has to open to follow an act hardly depends on
the machine.
"""

from __future__ import annotations

import sys
import threading
import time
from collections import Counter, deque
from collections.abc import Sequence
from pathlib import Path
from types import FrameType
from typing import Annotated, Any

import typer

import vlagents_ray
from benchmarks.calls import CallCounter, CountedNoop, counted
from benchmarks.console import Out, Transports, save, show_skipped
from benchmarks.figures import measured_on
from benchmarks.own_clients import OwnClient, connect, observation
from vlagents_ray.cli.console import errors, out, table
from vlagents_ray.cli.options import parse_list
from vlagents_ray.client.agent import RemoteAgent
from vlagents_ray.errors import ConfigError
from vlagents_ray.interface import Obs
from vlagents_ray.serve.launch.deployment_file import deployment
from vlagents_ray.serve.launch.server import running_server

POLICY = "benchmarks.act_path:TracedNoop"
WAYS = (
    OwnClient("shm"),
    OwnClient("plasma", actor=True),
    OwnClient("websocket", "jpeg"),
    OwnClient("http", "jpeg"),
)
_ROOT = Path(vlagents_ray.__file__).parents[1]
_PACKAGES = (f"{_ROOT / 'vlagents_ray'}/", f"{_ROOT / 'plugins'}/")
_WARM_UP = 3  # acts after a reset
_SETTLED_S = 0.02  # after its answer, the server records what an act took
_ENTRIES = 100_000  # more than an act has
_USUAL = 0.5  # share of the acts that enter a file

Entry = tuple[float, str]
"""When a function was called, s, of `time.perf_counter`, and its file."""


class PathCounter(CallCounter):
    """Counts calls, and notes when a function of this project is called."""

    def __init__(self) -> None:
        super().__init__()
        self.entries: deque[Entry] = deque(maxlen=_ENTRIES)

    def count(self, frame: FrameType, event: str, arg: Any) -> None:
        """Count an event of Python's profiler."""
        super().count(frame, event, arg)
        file = frame.f_code.co_filename
        if event == "call" and file.startswith(_PACKAGES):
            self.entries.append((time.perf_counter(), file))

    def files(self, begun_s: float, ended_s: float) -> list[str]:
        """Return the files that were entered between two times, each once, in order."""
        entered = [file for at_s, file in list(self.entries) if begun_s <= at_s <= ended_s]
        return [str(Path(file).relative_to(_ROOT)) for file in dict.fromkeys(entered)]


class TracedNoop(CountedNoop):
    """The policy whose acts are traced: `reset` returns counts, or the files of a period."""

    counter = PathCounter()

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        """Return the files that were entered from `begun_s` to `ended_s`; without these, counts.

        On Linux, `time.perf_counter` is the same clock in all processes.
        """
        if "begun_s" in kwargs:
            return {"files": self.counter.files(kwargs["begun_s"], kwargs["ended_s"])}
        return super().reset(obs, instruction, **kwargs)


def usual_files(acts: Sequence[Sequence[str]]) -> list[str]:
    """Return the files that most acts enter, in the order of the last act that enters them.

    Args:
        acts: The files of each act, in order.
    """
    entered: Counter[str] = Counter()
    for files in acts:
        entered.update(files)
    usual = {file for file, number in entered.items() if number > _USUAL * len(acts)}

    in_order: list[str] = []
    for files in reversed(acts):
        in_order += files
    return [file for file in dict.fromkeys(in_order) if file in usual]


def trace_files(
    agent: RemoteAgent, counter: PathCounter, obs: Obs, acts: int
) -> dict[str, list[str]]:
    """Return the files of one act, of the "client" and of the "server", whose policy is
    `TracedNoop`.

    Args:
        agent: The client.
        counter: Of the client's threads.
        obs: What each act sends.
        acts: Number of acts, of which the usual files are returned.
    """
    client: list[list[str]] = []
    server: list[list[str]] = []
    period: dict[str, Any] = {}
    for _ in range(acts + 1):
        info = agent.reset(obs, None, **period)
        if period:
            server.append(info["files"])
        for _ in range(_WARM_UP):
            agent.act(obs)

        time.sleep(_SETTLED_S)
        begun_s = time.perf_counter()
        sys.setprofile(counter.count)
        agent.act(obs)
        sys.setprofile(None)
        time.sleep(_SETTLED_S)
        period = {"begun_s": begun_s, "ended_s": time.perf_counter()}
        client.append(counter.files(**period))
    return {"client": usual_files(client), "server": usual_files(server)}


def trace_acts(ways: Sequence[OwnClient], acts: int) -> list[dict[str, Any]]:
    """Return the files and the counts of each client, which runs in this process, and of a
    replica.
    """
    found = []
    with running_server(deployment(POLICY)) as server:
        [(app, url)] = server.apps.items()
        for way in ways:
            counter = PathCounter()
            threading.setprofile(counter.count)  # of the threads that the client starts
            address = f"serve://{app}" if way.actor else url
            with connect(address, way.transport, way.codec) as agent:
                counts = counted(agent, observation(), acts)
                files = trace_files(agent, counter, observation(), min(acts, 20))
            threading.setprofile(None)
            sides = {side: counts[side] | {"files": files[side]} for side in files}
            found.append({"way": way.name.removesuffix(", Ray actor"), **sides})
    return found


def main(
    acts: Annotated[int, typer.Option(min=1, help="Acts that are counted.")] = 200,
    transports: Transports = "",
    out_file: Out = None,
) -> None:
    """Show the files of this project that one act enters, its calls of Python and C, and its
    system calls, by transport.
    """
    with errors():
        only = parse_list(transports)
        known = [way.transport for way in WAYS]
        unknown = sorted(set(only) - set(known))
        if unknown:
            raise ConfigError(f"transports: got {unknown}, want some of {sorted(known)}")
        ways = [way for way in WAYS if not only or way.transport in only]
        found = {
            **measured_on("python -m benchmarks.act_path"),
            "ways": trace_acts(ways, acts),
            "skipped": {},
        }
        if any("system" not in way["client"] for way in found["ways"]):
            found["skipped"]["system calls"] = "strace is not installed"
        show(found)
        save(found, out_file)


def show(found: dict[str, Any]) -> None:
    """Print the table of counts, and the files of each way."""
    names = ("Python", "C", "system")
    rows = table("way", "side", "files", *names)
    for way in found["ways"]:
        for side in ("client", "server"):
            counts = (f"{way[side].get(name, float('nan')):.1f}" for name in names)
            rows.add_row(way["way"], side, str(len(way[side]["files"])), *counts)
    out.print(rows)
    for way in found["ways"]:
        distinct = len({*way["client"]["files"], *way["server"]["files"]})
        out.print(f"\n{way['way']}: {distinct} distinct files")
        for side in ("client", "server"):
            out.print(f"  {side}: " + ", ".join(way[side]["files"]))
    show_skipped(found)


if __name__ == "__main__":
    typer.run(main)
