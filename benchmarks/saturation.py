"""Computes which part of a cluster with many workers saturates first, from the costs that
`benchmarks.scaling` has measured.

    python -m benchmarks.scaling --out scaling.json
    python -m benchmarks.saturation scaling.json --workers 1000

Each part has a load that grows with the workers, and a capacity. The loads of the driver and of
Ray's daemons on the head are extrapolated linearly from the measurements, but the driver queries at
most `QUERIES_PER_S` workers per second. The loads of replicas and of learners' images follow from
sizes and times. Nothing is simulated: where a load grows faster than linearly, as in a full
network, it is higher than computed.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from benchmarks.console import Out, save
from benchmarks.scaling import IMAGE_BYTES, OWN
from vlagents_ray.cli.console import errors, out, table
from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate.workers.pool import QUERIES_PER_S, WATCH_S

_BYTES_PER_MBIT = 1e6 / 8
ANSWERS = {
    "driver": "several drivers share a plan, and `merge` combines their results",
    "database": "the same: each driver has its own",
    "gcs_server": (
        "episodes are handed out by calls from the driver to the actor, which do not pass it"
    ),
    "ServeController": "acts do not pass it: a worker talks to its replica; fewer, larger replicas",
    "replicas": "the number of replicas grows with the workers; longer chunks, larger batches",
    "head's link": "observations stay on their node; only jobs and results pass",
    "learner's link": (
        "`images=False`; a learner of images takes fewer workers, each on a faster link"
    ),
}


@dataclass(frozen=True, slots=True)
class Load:
    """The work of the workers."""

    workers: int = 1000
    steps: int = 250  # number of steps in an episode
    episode_s: float = 30.0
    chunk: int = 8  # number of rows in an answer, all executed
    act_ms: float = 60.0  # duration of a batch, ms
    batch: int = 16
    replicas: int = 16  # number of replicas, one per GPU
    cameras: int = 2  # number of cameras of 224 x 224 in the transitions of a learner
    mbit: float = 10_000.0  # rate of a node's link, Mbit/s

    @property
    def acts_per_s(self) -> float:
        """The requests of one worker per second."""
        return self.steps / self.chunk / self.episode_s


@dataclass(frozen=True, slots=True)
class Part:
    """A part of the cluster: its load as a share of its capacity is `base` + `each` x workers."""

    name: str
    unit: str  # unit of the capacity
    base: float
    each: float

    def row(self, workers: int) -> dict[str, Any]:
        """Return the load with this number of workers, and the number that saturates the part; None
        if no number does.
        """
        saturates = (1 - self.base) / self.each if self.each > 0 else None
        load = self.base + self.each * workers
        return {**asdict(self), "load": load, "saturates": saturates, "answer": ANSWERS[self.name]}


def parts(scaling: Mapping[str, Any], load: Load) -> list[dict[str, Any]]:
    """Return the parts in the order in which they saturate.

    Args:
        scaling: The figures of `benchmarks.scaling`.
        load: The workers.

    Raises:
        ConfigError: The figures lack two numbers of workers on the same cluster.
    """
    cluster = scaling["clusters"][-1]
    rows = [row for row in cluster["rows"] if row["app"] == OWN]
    if len(rows) < 2:
        raise ConfigError(
            "scaling: expected two on the last cluster: --workers 1,16, got one number of workers"
        )
    costs, flooded = scaling["driver"]["costs_ms"], scaling["driver"]["flooded"]
    watched = min(load.workers, QUERIES_PER_S * WATCH_S)  # queried workers per second
    each_ms = (costs["episode"] + costs["step"] * load.steps) / load.episode_s
    base_ms = costs["second"] + costs["worker_second"] * watched
    batches = load.batch * load.replicas
    found = [
        Part("driver", "one core", base_ms / 1e3, each_ms / 1e3),
        Part(
            "database",
            "the driver's episodes/s, flooded",
            0.0,
            1 / load.episode_s / flooded["episodes_per_s"],
        ),
        Part(
            "replicas",
            f"{load.replicas} replicas",
            0.0,
            load.acts_per_s * load.act_ms / 1e3 / batches,
        ),
        Part(
            "learner's link",
            f"{load.mbit:g} Mbit/s",
            0.0,
            load.cameras
            * IMAGE_BYTES
            * load.steps
            / load.episode_s
            / (load.mbit * _BYTES_PER_MBIT),
        ),
    ]
    workers = [row["workers"] for row in rows]
    for daemon in ("gcs_server", "ServeController"):
        each, base = np.polyfit(workers, [row["daemon_shares"][daemon] for row in rows], 1)
        found.append(Part(daemon, "one core", max(0.0, float(base)), max(0.0, float(each))))
    if rows[-1]["sent_bytes_per_act"] is not None:
        sent = rows[-1]["sent_bytes_per_act"] * load.acts_per_s / (load.mbit * _BYTES_PER_MBIT)
        found.append(Part("head's link", f"{load.mbit:g} Mbit/s", 0.0, sent))
    found.sort(key=lambda part: -part.each / max(1e-9, 1 - part.base))
    return [part.row(load.workers) for part in found]


def show_parts(rows: list[dict[str, Any]], load: Load) -> None:
    """Print a row for each part."""
    grid = table(
        "part",
        "capacity",
        f"load at {load.workers}",
        "saturated by workers",
        "what the design does",
    )
    grid.title = (
        f"{load.workers} workers, episodes of {load.episode_s:g} s and {load.steps} steps, chunks "
        f"of {load.chunk}, batches of {load.batch} in {load.act_ms:g} ms"
    )
    for row in rows:
        limit = "none" if row["saturates"] is None else f"{row['saturates']:,.0f}"
        grid.add_row(row["name"], row["unit"], f"{row['load']:.1%}", limit, row["answer"])
    out.print(grid)


def main(
    scaling: Annotated[
        Path, typer.Argument(help="The figures of `python -m benchmarks.scaling --out`.")
    ],
    workers: Annotated[int, typer.Option(min=1)] = 1000,
    steps: Annotated[int, typer.Option(min=1, help="Number of steps of an episode.")] = 250,
    episode_s: Annotated[float, typer.Option(min=0.1, help="Duration of an episode, in s.")] = 30.0,
    chunk: Annotated[
        int, typer.Option(min=1, help="Number of rows in an answer, all of which are executed.")
    ] = 8,
    act_ms: Annotated[float, typer.Option(min=0, help="Duration of a batch, in ms.")] = 60.0,
    batch: Annotated[int, typer.Option(min=1, help="Number of rows in a batch.")] = 16,
    replicas: Annotated[int, typer.Option(min=1)] = 16,
    mbit: Annotated[
        float, typer.Option(min=1, help="Rate of a node's link, in Mbit/s.")
    ] = 10_000.0,
    out_file: Out = None,
) -> None:
    """Compute the load of each part of a cluster, and the number of workers that saturates it."""
    with errors():
        load = Load(workers, steps, episode_s, chunk, act_ms, batch, replicas, mbit=mbit)
        try:
            rows = parts(json.loads(scaling.read_text()), load)
        except (OSError, ValueError, KeyError) as error:
            raise ConfigError(
                f"{scaling}: got no figures of `python -m benchmarks.scaling --out` ({error!r})"
            ) from error
    show_parts(rows, load)
    save({"load": asdict(load), "parts": rows}, out_file)


if __name__ == "__main__":
    typer.run(main)
