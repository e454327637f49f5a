"""Counts the files and classes of this project that one warm inference call enters, in client and
server, for each transport. It also shows the calls of Python and C and the system calls, as
`benchmarks.calls` counts them.

A file or a class counts if most calls enter it, on any thread; a thread that wakes up by chance
during one call does not add its files. These numbers say how much code a reader has to open to
follow a call, and hardly depend on the machine.
"""

from __future__ import annotations

import sys
import threading
import time
from collections import Counter, deque
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import FrameType
from typing import Annotated, Any, NamedTuple

import typer

import vlagents_ray
from benchmarks.calls import CallCounter, CountedNoop, counted
from benchmarks.console import Out, TableOfPage, Transports, save, show_skipped
from benchmarks.figures import measured_on
from benchmarks.further_tables import replace_rows
from benchmarks.own_clients import OwnClient, connect, observation
from vlagents_ray.cli.console import errors, out, table
from vlagents_ray.cli.options import parse_list
from vlagents_ray.client.agent import RemoteAgent
from vlagents_ray.errors import ConfigError
from vlagents_ray.interface import Obs
from vlagents_ray.serve.launch.deployment_file import deployment
from vlagents_ray.serve.launch.server import running_server

POLICY = "benchmarks.act_path:TracedNoop"
CLIENTS = (
    OwnClient("shm"),
    OwnClient("plasma", actor=True),
    OwnClient("websocket", "jpeg"),
    OwnClient("http", "jpeg"),
    OwnClient("handle", actor=True),
)
SIDES = ("client", "server")
_COUNTS = ("Python", "C", "system")
_ROOT = Path(vlagents_ray.__file__).parents[1]
_PACKAGES = (f"{_ROOT / 'vlagents_ray'}/", f"{_ROOT / 'plugins'}/")
_WARM_UP = 3  # calls after a reset
_SETTLED_S = 0.02  # time for the server to record a call after its answer, s
_ENTRIES = 100_000  # maximum number of entries, more than a call has
_USUAL = 0.5  # minimum share of the calls that enter a file


class Entry(NamedTuple):
    """A call of a function of this project."""

    at_s: float  # time, s of `time.perf_counter`
    file: str
    class_name: str  # name of the class of the object whose method it is; "" for a function


class PathCounter(CallCounter):
    """Counts calls, and records the calls of this project's functions."""

    def __init__(self) -> None:
        super().__init__()
        self.entries: deque[Entry] = deque(maxlen=_ENTRIES)

    def count(self, frame: FrameType, event: str, arg: Any) -> None:
        """Count an event of Python's profiler."""
        super().count(frame, event, arg)
        file = frame.f_code.co_filename
        if event == "call" and file.startswith(_PACKAGES):
            self.entries.append(Entry(time.perf_counter(), file, _class_name(frame)))

    def path(self, begun_s: float, ended_s: float) -> dict[str, list[str]]:
        """Return the "files" and the "classes" that were entered between two times, each once, in
        order.
        """
        entered = [entry for entry in list(self.entries) if begun_s <= entry.at_s <= ended_s]
        files = dict.fromkeys(entry.file for entry in entered)
        classes = dict.fromkeys(entry.class_name for entry in entered if entry.class_name)
        return {
            "files": [str(Path(file).relative_to(_ROOT)) for file in files],
            "classes": list(classes),
        }


def _class_name(frame: FrameType) -> str:
    """Return the class of the object whose method a frame executes; "" if it is no method."""
    names = frame.f_code.co_varnames
    if not names or names[0] != "self":
        return ""
    return type(frame.f_locals["self"]).__name__ if "self" in frame.f_locals else ""


class TracedNoop(CountedNoop):
    """The policy whose calls are traced: its `reset` returns counts, or the path of a period."""

    counter = PathCounter()

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        """Return the path from `begun_s` to `ended_s`; without these times, return counts.

        On Linux, `time.perf_counter` is the same clock in all processes.
        """
        if "begun_s" in kwargs:
            return {"path": self.counter.path(kwargs["begun_s"], kwargs["ended_s"])}
        return super().reset(obs, instruction, **kwargs)


def usual(acts: Sequence[Sequence[str]]) -> list[str]:
    """Return the names that most calls enter, in the order of the last call that enters them.

    Args:
        acts: The files or the classes of each call, in order.
    """
    entered: Counter[str] = Counter()
    for names in acts:
        entered.update(names)

    in_order: list[str] = []
    for names in reversed(acts):
        in_order += names
    return [name for name in dict.fromkeys(in_order) if entered[name] > _USUAL * len(acts)]


def _usual_path(paths: Iterable[Mapping[str, Sequence[str]]]) -> dict[str, list[str]]:
    """Return the usual "files" and "classes" of the paths of several calls."""
    all_paths = list(paths)
    files = usual([path["files"] for path in all_paths])
    classes = usual([path["classes"] for path in all_paths])
    return {"files": files, "classes": classes}


def trace_path(
    agent: RemoteAgent, counter: PathCounter, obs: Obs, acts: int
) -> dict[str, dict[str, list[str]]]:
    """Return the "files" and the "classes" of one call in the "client" and in the "server", whose
    policy is `TracedNoop`.

    Args:
        agent: The client.
        counter: The counter of the client's threads.
        obs: The observation of each call.
        acts: Number of calls from which the usual path is computed.
    """
    client: list[dict[str, list[str]]] = []
    server: list[dict[str, list[str]]] = []
    period: dict[str, Any] = {}
    for _ in range(acts + 1):
        info = agent.reset(obs, None, **period)
        if period:
            server.append(info["path"])
        for _ in range(_WARM_UP):
            agent.act(obs)

        time.sleep(_SETTLED_S)
        begun_s = time.perf_counter()
        sys.setprofile(counter.count)
        agent.act(obs)
        sys.setprofile(None)
        time.sleep(_SETTLED_S)
        period = {"begun_s": begun_s, "ended_s": time.perf_counter()}
        client.append(counter.path(**period))
    return {"client": _usual_path(client), "server": _usual_path(server)}


def trace_acts(clients: Sequence[OwnClient], acts: int) -> list[dict[str, Any]]:
    """Return the path and the counts of each client, which runs in this process, and of a
    replica.
    """
    traced = []
    with running_server(deployment(POLICY)) as server:
        [(app, url)] = server.apps.items()
        for client in clients:
            counter = PathCounter()
            threading.setprofile(counter.count)  # counts on the threads that the client starts
            address = f"serve://{app}" if client.actor else url
            with connect(address, client.transport, client.codec) as agent:
                counts = counted(agent, observation(), acts)
                path = trace_path(agent, counter, observation(), min(acts, 20))
            threading.setprofile(None)
            sides = {side: counts[side] | path[side] for side in SIDES}
            traced.append({"way": client.name.removesuffix(", Ray actor"), **sides})
    return traced


def main(
    acts: Annotated[int, typer.Option(min=1, help="Number of calls that are counted.")] = 200,
    transports: Transports = "",
    table_of_page: TableOfPage = False,
    out_file: Out = None,
) -> None:
    """Show the files and classes of this project that one inference call enters, its calls of
    Python and C, and its system calls, for each transport.
    """
    with errors():
        only = parse_list(transports)
        known = [client.transport for client in CLIENTS]
        unknown = sorted(set(only) - set(known))
        if unknown:
            raise ConfigError(f"transports: expected only {sorted(known)}, got {unknown}")
        clients = [client for client in CLIENTS if not only or client.transport in only]
        measured = {
            **measured_on("python -m benchmarks.act_path"),
            "ways": trace_acts(clients, acts),
            "skipped": {},
        }
        if any("system" not in way["client"] for way in measured["ways"]):
            measured["skipped"]["system calls"] = "strace is not installed"
        if table_of_page:
            head, rows = page_table(measured["ways"])
            replace_rows("CPU cost of a call", head, rows, measured["date"])
            out.print("wrote the table; python -m benchmarks.report --from-json writes the page")
        else:
            show(measured)
        save(measured, out_file)


def page_table(ways: Sequence[Mapping[str, Any]]) -> tuple[list[str], list[list[str]]]:
    """Return the table of docs/measured_tables.md: its headings, and a row for each transport with
    the numbers of both sides.
    """
    numbers = ("files", "classes", *_COUNTS)
    head = ["transport"]
    for side in ("client", "replica"):
        head += [f"{side}: {numbers[0]}", *numbers[1:]]
    rows = []
    for way in ways:
        cells = [way["way"]]
        for side in SIDES:
            cells += _cells(way[side], decimals=0)
        rows.append(cells)
    return head, rows


def _cells(side: Mapping[str, Any], decimals: int) -> list[str]:
    """Return the numbers of one side of a call, as text."""
    sizes = [str(len(side[kind])) for kind in ("files", "classes")]
    counts = [f"{side[name]:.{decimals}f}" if name in side else "" for name in _COUNTS]
    return sizes + counts


def show(measured: Mapping[str, Any]) -> None:
    """Print the table of counts, and the path of each transport."""
    rows = table("way", "side", "files", "classes", *_COUNTS)
    for way in measured["ways"]:
        for side in SIDES:
            rows.add_row(way["way"], side, *_cells(way[side], decimals=1))
    out.print(rows)
    for way in measured["ways"]:
        for kind in ("files", "classes"):
            both = len({*way["client"][kind], *way["server"][kind]})
            out.print(f"\n{way['way']}: {both} distinct {kind}")
            for side in SIDES:
                out.print(f"  {side}: " + ", ".join(way[side][kind]))
    show_skipped(measured)


if __name__ == "__main__":
    typer.run(main)
