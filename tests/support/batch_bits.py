"""A search for actions whose bits depend on the batch in which they are computed."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from vlagents_ray import Act, Agent, Obs
from vlagents_ray.interface import DISTRIBUTION
from vlagents_ray.policies.loading import LoadingReport, loading_report

ROBOTS = 11  # more than one pass of any size that is a power of two below 16


@contextmanager
def invariant(rows: int) -> Iterator[LoadingReport]:
    """Load policies in this context as a server with `batch: {invariant: true}` does."""
    with loading_report(lambda _: None, [rows], invariant=True) as report:
        yield report


def differing_acts(
    policy: Agent,
    begin: Callable[[int], Agent],
    observe: Callable[[int, int], Obs],
    *,
    ticks: int = 3,
    rounds: int = 4,
    seed: int = 0,
) -> tuple[int, list[str]]:
    """Compute the episodes of robots alone, and then in random batches, in random order.

    Args:
        policy: The loaded policy.
        begin: Returns a new session of a robot, in its episode.
        observe: Returns the observation of a robot at a tick.
        ticks: The number of acts of each robot.
        rounds: The number of times that all episodes are computed in batches.
        seed: The seed of the batches.

    Returns:
        The number of compared acts, and a description of each act whose bits differ.
    """
    alone = {}
    for robot in range(ROBOTS):
        session = begin(robot)
        for tick in range(ticks):
            [act] = policy.act_batch([observe(robot, tick)], [session])
            alone[robot, tick] = _bytes_of(act)

    rng = np.random.default_rng(seed)
    compared, differing = 0, []
    for _ in range(rounds):
        sessions = [begin(robot) for robot in range(ROBOTS)]
        for tick in range(ticks):
            order = rng.permutation(ROBOTS)
            ends = np.sort(rng.choice(ROBOTS, rng.integers(ROBOTS), replace=False))
            for batch in filter(len, np.split(order, ends)):
                acts = policy.act_batch(
                    [observe(robot, tick) for robot in batch], [sessions[robot] for robot in batch]
                )
                for place, (robot, act) in enumerate(zip(batch, acts, strict=True)):
                    compared += 1
                    if _bytes_of(act) != alone[robot, tick]:
                        differing.append(f"robot {robot}, tick {tick}: {place} of {len(batch)}")
    return compared, differing


def _bytes_of(act: Any) -> list[bytes]:
    """Return the bytes of an answer: its action, and its samples."""
    if not isinstance(act, Act):
        raise act
    samples = act.info.get(DISTRIBUTION, {}).get("samples")
    return [np.asarray(values).tobytes() for values in (act.action, samples) if values is not None]
