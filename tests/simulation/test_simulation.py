"""Histories of sessions under faults. Each is drawn from a seed, and takes a few milliseconds.

VLAGENTS_SIMULATION_SEED=1234 pytest tests/simulation -s     replays a seed that failed, and prints
its history VLAGENTS_SIMULATION_SEEDS=100000 pytest tests/simulation     more of them than 2,000
"""

from __future__ import annotations

import logging
import math
import os
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import in_flight
import pytest

from tests.simulation.clients import Robot, Violation, play
from tests.simulation.world import Replica, World
from vlagents_ray.errors import PolicyUnavailable, UnknownSession, VLAgentsError
from vlagents_ray.serve.requests import (
    Answer,
    Opening,
    Origin,
    PendingRequest,
    ReservedAct,
    deliver,
)
from vlagents_ray.serve.scaling import session_migration
from vlagents_ray.serve.sessions import Past, Session, SessionState, SessionUse

# With so many seeds, the simulation finds each of the bugs below.
SEEDS = int(os.environ.get("VLAGENTS_SIMULATION_SEEDS", "2000"))
SEED = os.environ.get("VLAGENTS_SIMULATION_SEED")


@pytest.fixture(autouse=True)
def _quiet() -> Iterator[None]:
    """Disable the replicas' logs of faults, which would take more time than everything else."""
    logging.disable(logging.CRITICAL)
    yield
    logging.disable(logging.NOTSET)


def run(seed: int, **world: Any) -> list[Robot]:
    """Run a seed. An error contains the command that runs the seed again."""
    try:
        return play(World(seed, **world))
    except Exception as error:
        raise Violation(
            f"seed {seed}: {error}\nagain: VLAGENTS_SIMULATION_SEED={seed} pytest tests/simulation"
        ) from error


def run_all(seeds: int, **world: Any) -> None:
    """Run the first `seeds` seeds."""
    for seed in range(seeds):
        run(seed, **world)


@pytest.mark.timeout(900)
@pytest.mark.slow
def test_no_history_is_impossible() -> None:
    if SEED is not None:
        show(int(SEED))
        return
    seen: Counter[str] = Counter()
    for seed in range(SEEDS):
        for robot in run(seed):
            seen.update(line.split()[1] + " " + line.split()[-1] for line in robot.history)
    print(seen)
    assert seen["act ok"] > SEEDS, "too few acts succeeded for a judgement"


def show(seed: int) -> None:
    """Run a seed and print its history."""
    world = World(seed)
    print(world.plan.__dict__)
    try:
        robots = play(world)
    finally:
        print(*world.log.acts, sep="\n")
    for robot in robots:
        print(robot.name, *robot.history, sep="\n")


def test_a_seed_is_one_history() -> None:
    for seed in range(20):
        assert [robot.history for robot in run(seed)] == [robot.history for robot in run(seed)]


def overwrite(replica: Replica) -> None:
    """A bug: an arriving session replaces any session here, and resets are not announced."""
    table = replica.engine.sessions

    def enter(arriving: Session) -> None:
        if (here := table._sessions.get(arriving.id)) is not None:
            table._end(here)
        table._sessions[arriving.id] = arriving

    table.enter = enter  # type: ignore[method-assign]

    def announce(session: Session, answer: Answer) -> None:
        deliver([answer])

    replica.migrator.announce = announce  # type: ignore[method-assign]


def export_at_once(replica: Replica) -> None:
    """A bug: copying a session gives it up, whether or not the other replica still waits."""
    held = replica.migrator.sessions

    async def copy(session_id: str, offered: bool = False) -> SessionState | None:
        info = await held._ask(session_id, "export", None, asked=replica.engine.clock())
        if info is None:
            return None
        replica.engine.sessions.close(session_id)
        replica.engine.sessions._left.clear()
        return SessionState.from_info(info)

    async def release(*_: Any) -> bool:
        return True

    held.copy = copy  # type: ignore[method-assign]
    held.release = release  # type: ignore[method-assign]


def deadlines_begin_anew(replica: Replica) -> None:
    """A bug: the deadline counts again from the time when the session was fetched, and earlier
    answers are not checked.
    """
    engine = replica.engine

    def seek(pending: PendingRequest, error: VLAgentsError) -> bool:
        def retry() -> None:
            try:
                again = in_flight.pending(pending.session_id, pending.request)
                again.message, again.index = pending.message, pending.index
                again.reserved = engine.intake.reserve(again)
                engine.queue.put(again)
            except VLAgentsError as later:
                pending.fail(later)

        if (
            pending.request.op != "act"
            or not isinstance(error, UnknownSession)
            or engine.finder is None
        ):
            return False
        if not engine.finder.fetch(pending.session_id, retry):
            pending.fail(PolicyUnavailable("the replica is stopping"))
        return True

    engine.intake.search = seek  # type: ignore[method-assign]


def forget_episodes(replica: Replica) -> None:
    """A bug: an act without a step belongs to the session's episode at the time when the policy is
    free.
    """
    reserve, fetch = replica.engine.intake.reserve, replica.migrator.fetch

    def reserve_and_forget(pending: PendingRequest) -> ReservedAct | Opening | None:
        reserved = reserve(pending)
        pending.episode = None
        if not pending.origin.owner:
            pending.origin = replace(pending.origin, owner="any")
        pending.origin.opened = math.inf
        return reserved

    def fetch_any(session_id: str, then: Callable[[], None], caller: str, use_of: Any) -> bool:
        origin = use_of.__self__._pending.origin
        return fetch(session_id, then, caller, lambda *_: SessionUse(origin))

    replica.engine.intake.reserve = reserve_and_forget  # type: ignore[method-assign]
    replica.migrator.fetch = fetch_any  # type: ignore[method-assign]


def outlive_connections(replica: Replica) -> None:
    """A bug: the requests of a closed connection still wait for the policy."""
    close_owned = replica.engine.sessions.close_owned

    def forget_the_end(origin: Origin) -> None:
        for pending in (*replica.engine.queue._waiting.clear(), *replica.engine.queue._running):
            if pending.origin is origin:
                pending.origin.ended = False
            if not pending.begun:
                replica.engine.queue.put(pending)
        close_owned(origin)

    replica.engine.sessions.close_owned = forget_the_end  # type: ignore[method-assign]
    forget_episodes(replica)


def trust_clocks(replica: Replica) -> None:
    """A bug: a step is not raised above the greater step of an older episode."""
    drop_older = replica.engine.sessions.drop_older

    def drop_and_be_silent(episodes: Any) -> dict[str, Past]:
        drop_older(episodes)
        return {}

    replica.engine.sessions.drop_older = drop_and_be_silent  # type: ignore[method-assign]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("world", "sign"),
    [
        ({"spoil": overwrite}, "from an older episode|a session was|lost or doubled"),
        ({"spoil": export_at_once}, "a session was"),
        ({"spoil": deadlines_begin_anew}, "never would be|lost or doubled|sent in episode"),
        ({"spoil": forget_episodes}, "sent in episode"),
        ({"spoil": outlive_connections}, "sent in episode"),
        ({"spoil": trust_clocks}, "from an older episode|sent in episode|a session was"),
    ],
    ids=[
        "older episodes overwrite",
        "a slow export destroys",
        "deadlines begin anew",
        "acts of any episode",
        "ended connections act",
        "a clock that is ahead wins",
    ],
)
def test_the_simulation_finds_what_was_wrong_before(
    world: dict[str, Callable[..., Any]], sign: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if world["spoil"] is export_at_once:
        monkeypatch.setattr(session_migration, "EXPORT_S", 3.0)
    with pytest.raises(Violation, match=sign) as violation:
        run_all(2000, **world)
    print(violation.value)
