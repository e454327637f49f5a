"""A control loop with a slow server, which is also killed and restarted while the loop runs."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ray_processes import free_address, serving

from vlagents_ray import Act, Agent, Obs, RemoteAgent
from vlagents_ray.chunking.player import ChunkPlayer, PlayerSettings
from vlagents_ray.cli.robot import main
from vlagents_ray.client.transports.select import TransportName
from vlagents_ray.robot import LoopOptions, Watchdog, run_loop
from vlagents_ray.robot.pacing import Pacer, jitter, undisturbed

HZ = 50.0
ROWS = 50
PATIENCE_S = 300.0
# Number of attempts at a measurement that a pause of the machine for a second can spoil.
ATTEMPTS = 5

pytestmark = [pytest.mark.alone, pytest.mark.slow, pytest.mark.integration]


class Counter:
    """A robot whose observation is the number of the tick."""

    def __init__(self) -> None:
        self.tick = -2  # the loop passes observations to the reset before its first tick

    def observe(self) -> Obs:
        self.tick += 1
        return Obs(
            {"front": np.zeros((224, 224, 3), np.uint8)},
            state={"tick": np.array([max(0, self.tick)], np.float32)},
        )

    def apply(self, action: np.ndarray) -> None:
        pass

    def stop(self) -> None:
        pass


class Witness(Agent):
    """Stores the actions that a player returned, and checks that no stale one is among them."""

    def __init__(self, player: ChunkPlayer, robot: Counter) -> None:
        self.player, self.robot = player, robot
        self.acts: list[Act] = []
        self.executed = {0: 0}  # number of the policy's actions before each tick
        self.longest_s = 0.0

    @property
    def contract(self) -> Any:
        return self.player.contract

    def reset(self, obs: Obs, instruction: str | None = None, **kwargs: Any) -> dict[str, Any]:
        return self.player.reset(obs, instruction, **kwargs)

    def act(self, obs: Obs) -> Act:
        begun = time.perf_counter()
        act = self.player.act(obs)
        self.longest_s = max(self.longest_s, time.perf_counter() - begun)
        executed = self.executed[self.robot.tick] = sum("safe" not in one.info for one in self.acts)
        self.acts.append(act)
        if "safe" in act.info:
            # The robot holds its position.
            assert act.action.tolist() == self.acts[-2].action.tolist()
        else:
            asked, row = act.action.tolist()
            assert row == min(executed - self.executed[asked], ROWS - 1), (
                "an action for another tick"
            )
        return act

    def good_since(self, tick: int) -> int:
        """Return the number of the policy's actions that were computed from observations after
        `tick`.
        """
        return sum("safe" not in act.info and act.action[0] > tick for act in self.acts)


@pytest.fixture(scope="module")
def address() -> str:
    return free_address()


@pytest.fixture(scope="module")
def server(
    address: str, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[contextlib.ExitStack]:
    """Return the context in which the server at `address` runs; closing it stops the server."""
    with contextlib.ExitStack() as running:
        running.enter_context(
            serving("served_agents:Ticking", tmp_path_factory.mktemp("log") / "log", address)
        )
        yield running


@contextlib.contextmanager
def witness(address: str, transport: TransportName) -> Iterator[Witness]:
    robot = Counter()
    agent = RemoteAgent(f"http://{address}", transport=transport)
    with ChunkPlayer(agent, PlayerSettings(mode="async")) as player:
        yield Witness(player, robot)


def empty_loop() -> dict[str, float]:
    """Return the jitter of an empty loop of two seconds, as the best possible value on this
    machine.
    """
    with undisturbed():
        pacer = Pacer(HZ)
        while pacer.wait() < 2 * HZ:
            pass
    return jitter(pacer.late_s, pacer.missed, pacer.ticks)


@pytest.mark.parametrize("transport", ["websocket", "shm"])
def test_no_tick_is_without_an_action_though_an_answer_takes_ten_ticks(
    server: contextlib.ExitStack, address: str, transport: TransportName
) -> None:
    for _ in range(ATTEMPTS):
        with witness(address, transport) as seen:
            report = run_loop(seen.robot, seen, hz=HZ, seconds=5)
        machine = empty_loop()
        if report.safe_ticks == 0 and report.jitter["on_time"] > 0.9 * machine["on_time"]:
            break
    else:
        pytest.fail(f"{report}; jitter of an empty loop: {machine}")
    assert len({act.info["chunk"] for act in seen.acts}) > 5


def test_the_command_drives_records_and_reports(
    server: contextlib.ExitStack, address: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for attempt in range(ATTEMPTS):
        folder = tmp_path / str(attempt)
        options = ["--seconds", "2", "--record", str(folder), "--instruction", "stack the cups"]
        status, said = main([f"http://{address}", *options]), capsys.readouterr().out
        if status == 0:
            break
    assert status == 0, said
    assert "ticks without an action of the policy: 0" in said
    assert f"recorded: 1 episodes in {folder}" in said
    info = json.loads((folder / "meta/info.json").read_text())
    assert (info["total_episodes"], info["fps"]) == (1, 50)


def test_a_killed_replica_and_a_restarted_server_cost_safe_ticks_and_nothing_else(
    server: contextlib.ExitStack, address: str, tmp_path: Path
) -> None:
    barks: list[str] = []
    with contextlib.ExitStack() as stack:
        seen = stack.enter_context(witness(address, "websocket"))
        script = _disasters(seen, server, stack, address, tmp_path)
        deadline = time.monotonic() + PATIENCE_S
        next(script)
        report = run_loop(
            seen.robot,
            seen,
            hz=HZ,
            watchdog=Watchdog(barks.append, {"server": 2.0}),
            until=lambda: time.monotonic() > deadline or next(script, True),
            options=LoopOptions(restart="auto"),
        )
        assert next(script, True), f"the session was not resumed: {report}"
    # In both cases the server was down for longer than a chunk lasts.
    assert report.safe_ticks > 2 * ROWS
    assert seen.longest_s < 5.0, "a tick waited for the server's restart"
    assert barks


def _disasters(
    seen: Witness,
    server: contextlib.ExitStack,
    stack: contextlib.ExitStack,
    address: str,
    folder: Path,
) -> Iterator[bool]:
    """Run the disasters one after the other, tick by tick, each after the policy has driven the
    robot for a while.
    """
    yield False
    while seen.good_since(0) < ROWS:
        yield False
    os.kill(seen.acts[-1].info["pid"], signal.SIGKILL)
    killed = seen.robot.tick
    while seen.good_since(killed + 2 * ROWS) < ROWS:
        yield False

    def restart() -> None:
        server.close()
        stack.enter_context(serving("served_agents:Ticking", folder / "log", address))

    again = threading.Thread(target=restart)
    again.start()
    stopped = seen.robot.tick
    while again.is_alive() or seen.good_since(stopped + 2 * ROWS) < ROWS:
        yield False
