"""Measures a robot whose policy is far away: `python -m benchmarks.far_away`.

The server and the robot are on two hosts of this machine (`benchmarks.hosts`), connected by a link
with delay, loss and cuts (`benchmarks.far_link`). Each mode of the chunk player drives the robot
over each link. Needs Linux and root.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Annotated, Any

import numpy as np
import typer

from benchmarks.console import Out, save
from benchmarks.far_carrier import Conditions
from benchmarks.far_link import FarLink
from benchmarks.far_robot import HZ, MODES
from benchmarks.hosts import Host, hosts
from benchmarks.line_process import LineProcess, our_environment
from vlagents_ray.cli.console import errors, out, progress, table
from vlagents_ray.errors import ConfigError

PORT = 8000
_START_S = 180.0
_CUT_AFTER_S = 4.0


@dataclass(frozen=True, slots=True)
class Row:
    """The figures of one mode over one link."""

    link: str
    mode: str
    period_error_p50_ms: float  # difference of the time between two ticks from the period, ms
    period_error_p99_ms: float
    acted: float  # share of the ticks with an action of the policy
    longest_without_s: float
    spells: int  # periods of ticks without an action of the policy
    spell_p50_s: float
    age_p50_ms: float  # age of the observation behind the policy's executed actions, ms
    age_p99_ms: float
    step_p99: float  # distance of consecutive actions of the policy
    stops: int  # number of stops by the watchdog
    reconnects: int
    twice: int  # number of observations that the policy received twice in one session
    recovered_s: float | None  # time from the end of the cut to the next action of the policy, s
    transport: str
    codec: str


@contextlib.contextmanager
def served(host: Host, port: int = PORT) -> Iterator[LineProcess]:
    """Serve the policy on a host."""
    command = host.command([sys.executable, "-m", "benchmarks.far_server", str(port)])
    with LineProcess("the server", command, our_environment()) as process:
        process.read(_START_S)
        yield process


@contextlib.contextmanager
def robot(host: Host, url: str) -> Iterator[LineProcess]:
    """Start the robot's process on a host."""
    command = host.command([sys.executable, "-m", "benchmarks.far_robot", url])
    with LineProcess("the robot", command, our_environment()) as process:
        process.read(_START_S)
        yield process


def run(
    arm: LineProcess,
    link: FarLink,
    conditions: Conditions,
    cut_s: float = 0.0,
    cut_after_s: float = _CUT_AFTER_S,
    *,
    seconds: float,
    **how: Any,
) -> tuple[dict[str, Any], float | None]:
    """Run the robot over the link, which is cut for a while.

    Args:
        arm: The robot's process.
        link: The link.
        conditions: The delay, loss and rate of the link.
        cut_s: The duration of the cut, s; 0 for no cut.
        cut_after_s: The time of the cut after the beginning of the run, s.
        seconds: The length of the run, s.
        how: Further arguments of `benchmarks.far_robot.drive`.

    Returns:
        The robot's record, and the end of the cut, s of `time.monotonic`; None without a cut.
    """
    link.set(conditions)
    arm.send(json.dumps({"seconds": seconds, **how}))
    begun = arm.read(_START_S)
    if begun != "begun":
        raise ConfigError(f"the robot: expected that it begins, got {begun!r}")
    healed = None
    if cut_s:
        time.sleep(cut_after_s)
        link.set(Conditions(cut=True))
        time.sleep(cut_s)
        link.set(conditions)
        healed = time.monotonic()
    found: dict[str, Any] = arm.read(seconds + _START_S)
    return found, healed


def row(link: str, mode: str, found: dict[str, Any], healed: float | None) -> Row:
    """Compute the figures of a run."""
    ticks = found["ticks"]
    at = np.array(ticks["at_s"][1:])
    acted = np.array(ticks["acted"][1:])
    error_ms = np.abs(np.diff(at) - 1 / HZ) * 1e3
    lengths = [len(list(group)) / HZ for one, group in itertools.groupby(acted) if not one]
    age_ms = np.array(ticks["age_ticks"]) * 1e3 / HZ
    after = at[acted & (at > healed)] if healed is not None else at[:0]
    return Row(
        link=link,
        mode=mode,
        period_error_p50_ms=float(np.median(error_ms)),
        period_error_p99_ms=float(np.quantile(error_ms, 0.99)),
        acted=float(acted.mean()),
        longest_without_s=max(lengths, default=0.0),
        spells=len(lengths),
        spell_p50_s=float(np.median(lengths)) if lengths else 0.0,
        age_p50_ms=float(np.median(age_ms)),
        age_p99_ms=float(np.quantile(age_ms, 0.99)),
        step_p99=float(np.quantile(ticks["step"], 0.99)),
        stops=len(found["barks"]),
        reconnects=found["reconnects"],
        twice=ticks["twice"],
        recovered_s=float(after[0] - healed) if healed is not None and len(after) else None,
        transport=found["transport"],
        codec=found["codec"],
    )


def measure(
    delay_ms: float,
    loss: float,
    mbit: float,
    cut_s: float,
    seconds: float,
    modes: Sequence[str],
    congestion: str,
    say: Callable[[str], None] = lambda _: None,
) -> list[Row]:
    """Run each mode over a link without faults, over a long link, over a long link that loses
    packets, and over the same link with a cut.
    """
    rate = f"{mbit:g} Mbit/s"
    links = {
        f"clean, {rate}": (Conditions(mbit=mbit), 0.0),
        f"{delay_ms:g} ms each way": (Conditions(delay_ms, 0.0, mbit), 0.0),
        f"{delay_ms:g} ms, {100 * loss:g} % lost": (Conditions(delay_ms, loss, mbit), 0.0),
        f"{delay_ms:g} ms, {100 * loss:g} % lost, cut for {cut_s:g} s": (
            Conditions(delay_ms, loss, mbit),
            cut_s,
        ),
    }
    rows = []
    with (
        hosts(2) as [cloud, home],
        FarLink(cloud, home, congestion) as link,
        served(cloud),
        robot(home, f"http://{link.address}:{PORT}") as arm,
    ):
        for (name, (conditions, cut)), mode in itertools.product(links.items(), modes):
            found, healed = run(arm, link, conditions, cut, seconds=seconds + cut, mode=mode)
            rows.append(row(name, mode, found, healed))
            say(f"{name}, {mode}: {rows[-1]}")
    return rows


def main(
    delay_ms: Annotated[
        float, typer.Option(min=0, help="Delay of the link in each direction, in ms.")
    ] = 80.0,
    loss: Annotated[
        float, typer.Option(min=0, max=0.5, help="Share of lost packets in each direction.")
    ] = 0.02,
    mbit: Annotated[
        float, typer.Option(min=0.1, help="Rate of the link in each direction, in Mbit/s.")
    ] = 20.0,
    cut_s: Annotated[float, typer.Option(min=0.1, help="Duration of the cut, in seconds.")] = 10.0,
    seconds: Annotated[
        float, typer.Option(min=8, help="Duration of each run without the cut, in seconds.")
    ] = 10.0,
    modes: Annotated[
        str, typer.Option(help="Modes, separated by commas; default: all.")
    ] = ",".join(MODES),
    congestion: Annotated[
        str, typer.Option(help="TCP's congestion control: cubic, bbr.")
    ] = "cubic",
    out_file: Out = None,
) -> None:
    """Measure a robot whose policy is far away."""
    with errors():
        chosen = modes.split(",")
        if unknown := sorted(set(chosen) - set(MODES)):
            raise ConfigError(f"--modes: expected only {list(MODES)}, got {unknown}")
        rows = measure(delay_ms, loss, mbit, cut_s, seconds, chosen, congestion, progress)
    shown = table(
        "link",
        "mode",
        "period error p50/p99",
        "acted",
        "longest without",
        "spells (median)",
        "age p50/p99",
        "step p99",
        "stops",
        "recovered",
    )
    for one in rows:
        shown.add_row(*_shown(one))
    out.print(shown)
    save({"congestion": congestion, "rows": [asdict(one) for one in rows]}, out_file)


def _shown(one: Row) -> tuple[str, ...]:
    return (
        one.link,
        one.mode,
        f"{one.period_error_p50_ms:.1f} / {one.period_error_p99_ms:.1f} ms",
        f"{one.acted:.0%}",
        f"{one.longest_without_s:.1f} s",
        f"{one.spells} ({one.spell_p50_s:.2f} s)",
        f"{one.age_p50_ms:.0f} / {one.age_p99_ms:.0f} ms",
        f"{one.step_p99:.3f}",
        f"{one.stops}",
        "" if one.recovered_s is None else f"{one.recovered_s:.1f} s",
    )


if __name__ == "__main__":
    typer.run(main)
