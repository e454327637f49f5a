"""Traces: the recorded messages and answers of a scenario, in a file. Running a trace again shows
what has changed.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from difflib import unified_diff
from pathlib import Path
from typing import Any

import pytest

from tests.golden.lines import Line, WebSocketLine
from tests.golden.masks import as_text, described, from_text
from tests.golden.replica import Server

TRACES = Path(__file__).parent / "traces"


@dataclass(frozen=True)
class Step:
    """One step of a scenario.

    Args:
        who: The name of a line; or "server" for an event at the server.
        what: "sends", "gets", "opens" (and gets the answer to the handshake), "finishes" (sends no
            more, and gets all bytes until the end), or "leaves"; for the server, an event of
            `Server.do`.
        data: The sent or received message, and the data outside of it. `kind` is the kind of a
            received message.
    """

    who: str
    what: str
    kind: str = ""
    data: tuple[bytes, ...] = ()

    def lines(self) -> list[str]:
        """Return the lines of the step for a reader."""
        head = f"{self.who} {self.what} {self.kind}".strip()
        return [head, *(f"    {line}" for data in self.data for line in described(data))]


@dataclass
class Trace:
    """A scenario, and the endpoints at which its bytes are the same."""

    name: str
    endpoints: list[str]
    settings: dict[str, Any]
    steps: list[Step] = field(default_factory=list)

    def sent(self) -> Trace:
        """Return the trace without the answers."""
        return replace(
            self,
            steps=[one if one.what == "sends" else Step(one.who, one.what) for one in self.steps],
        )

    def played(self, endpoint: str, folder: Path) -> Trace:
        """Send the messages to a new server, and return the trace with its answers."""
        with pytest.MonkeyPatch.context() as patch, contextlib.ExitStack() as stack:
            server = Server(stack, patch, folder, **self.settings)
            return self.played_at(server, endpoint, stack)

    def played_at(self, server: Server, endpoint: str, stack: contextlib.ExitStack) -> Trace:
        """Send the messages to a server whose connections stay open until `stack` is closed, and
        return the trace with its answers.
        """
        lines: dict[str, Line] = {}
        stack.callback(lambda: [line.close() for line in lines.values()])
        steps = [_played(step, server, endpoint, lines) for step in self.steps]
        return Trace(self.name, [endpoint], self.settings, steps)


def _played(step: Step, server: Server, endpoint: str, lines: dict[str, Line]) -> Step:
    if step.who == "server":
        server.do(step.what)
        return step
    if step.who not in lines:
        lines[step.who] = server.line(endpoint, step.who)
    line, got = lines[step.who], None
    if step.what == "sends":
        line.send(step.data[0], list(step.data[1:]))
    elif step.what == "leaves":
        lines.pop(step.who).close()
    elif step.what == "opens":
        assert isinstance(line, WebSocketLine)
        got = line.opened
    elif step.what == "finishes":
        got = line.finish()
    else:
        got = line.receive()
    return step if got is None else Step(step.who, step.what, got[0], (got[1],))


def differences(recorded: Trace, played: Trace) -> str:
    """Return the differences for a reader; empty if there are none."""
    found = ["another number of steps"] * (len(recorded.steps) != len(played.steps))
    for number, (before, now) in enumerate(zip(recorded.steps, played.steps, strict=False)):
        if before == now:
            continue
        lines = list(
            unified_diff(before.lines(), now.lines(), "recorded", "now", n=0, lineterm="")
        )[2:]
        found += [
            f"step {number}: {now.who} {now.what}",
            *(line for line in lines if line[0] in "+-"),
        ]
    return "\n".join(found)


def read(name: str, folder: Path = TRACES) -> list[Trace]:
    """Return the traces in a file. A trace has its name, a line with its endpoints and the server's
    settings, and its steps.
    """
    found: list[Trace] = []
    for part in (folder / f"{name}.txt").read_text().split("== ")[1:]:
        title, head, *lines = part.splitlines()
        found.append(Trace(title, *json.loads(head)))
        for line in lines:
            if line.startswith("  "):
                step = found[-1].steps.pop()
                found[-1].steps.append(replace(step, data=(*step.data, from_text(line[2:]))))
            else:
                found[-1].steps.append(Step(*line.split("; ")))
    return found


def write(name: str, traces: Sequence[Trace], folder: Path = TRACES) -> None:
    """Write traces to a file."""
    lines = []
    for one in traces:
        lines += [f"== {one.name}", json.dumps([one.endpoints, one.settings])]
        for step in one.steps:
            words = (step.who, step.what, step.kind)
            lines += ["; ".join(filter(None, words)), *(f"  {as_text(data)}" for data in step.data)]
    (folder / f"{name}.txt").write_text("\n".join(lines) + "\n")
