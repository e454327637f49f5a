"""A human at the live page moves a robot over the server: who may, who goes first, and what the robot does."""

from __future__ import annotations

import json
import logging
import re
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from eval_fakes import wait_for
from in_memory_keys import ChangingKeys
from live_server import METADATA, LiveServer, ask, live_server
from remote_human import CuttableLink, RemoteHuman, remote_human

from vlagents_ray import Act, ActionSpec, Agent, Contract, Forbidden, Obs, RemoteAgent, Unauthorized
from vlagents_ray.chunking.player import ChunkPlayer
from vlagents_ray.client.credentials import Credentials
from vlagents_ray.client.steering import ROBOT_PATH
from vlagents_ray.client.transports.websocket import open_websocket
from vlagents_ray.interface import INTERVENTION
from vlagents_ray.robot import Guard, LoopReport, run_loop
from vlagents_ray.robot.__main__ import main
from vlagents_ray.robot.record import Recorder
from vlagents_ray.robot.teleoperation import Leader, RemoteLeader, keyboard, remote
from vlagents_ray.serve.access import api_keys
from vlagents_ray.serve.live.endpoint import live_page
from vlagents_ray.serve.live.remote import robot_links

CONTRACT = Contract(action=ActionSpec(dim=2, delta=False, low=-50.0, high=50.0))
STEP, MAX_STEP, HZ = 0.02, 0.05, 50.0


class Going(Agent):
    """Goes on by 0.01 a tick from where the robot stands."""

    contract = CONTRACT

    def act(self, obs: Obs) -> Act:
        return Act((obs.state["joints"] + 0.01 * np.arange(1, 9)[:, np.newaxis]).astype(np.float32))


class Arm:
    """Stands at once where it is commanded to, and notes when."""

    simulated = True

    def __init__(self) -> None:
        self.commanded: list[tuple[float, np.ndarray]] = []
        self.after: Callable[[], None] = lambda: None

    def observe(self) -> Obs:
        at = self.commanded[-1][1] if self.commanded else np.zeros(2)
        return Obs(state={"joints": at.astype(np.float32)})

    def apply(self, action: np.ndarray) -> None:
        self.commanded.append((monotonic(), action.copy()))
        self.after()

    def stop(self) -> None: ...

    def moved_since(self, begun: float) -> bool:
        """Whether it has gone on since a time, and not only held still."""
        at = [action for when, action in self.commanded if when >= begun]
        return any((one != at[0]).any() for one in at)


class Driven:
    """A robot that is driven over a server, and may be moved remotely."""

    def __init__(self, player: ChunkPlayer, arm: Arm, agent: RemoteAgent, leader: RemoteLeader | None) -> None:
        self.player, self.arm, self.agent, self.leader = player, arm, agent, leader
        self.led = 0  # ticks of a human
        self.reports: list[LoopReport] = []

    @property
    def state(self) -> str:
        return self.player.takeover.state


@contextmanager
def driven(
    server: LiveServer,
    key: str | None = None,
    *,
    port: int | None = None,
    offered: bool = True,
    local: Leader | None = None,
    recorder: Recorder | None = None,
) -> Iterator[Driven]:
    over, arm = threading.Event(), Arm()
    with ExitStack() as stack:
        agent = stack.enter_context(
            RemoteAgent(f"http://127.0.0.1:{port or server.port}", transport="websocket", api_key=key, timeout_s=2.0)
        )
        agent.initialize()
        leader = None
        if offered:
            leader = stack.enter_context(RemoteLeader(agent, CONTRACT, step=STEP, local=local))
        guard = Guard(CONTRACT, max_step=MAX_STEP, measure=lambda obs: obs.state["joints"])
        player = ChunkPlayer(agent, mode="async", deadline_s=0.01, safe="hold", check=guard, override=leader)
        robot = Driven(player, arm, agent, leader)
        act = player.act

        def counted(obs: Obs) -> Act:
            acted = act(obs)
            robot.led += bool(acted.info.get(INTERVENTION))
            return acted

        player.act = counted  # type: ignore[method-assign]
        thread = threading.Thread(
            target=lambda: robot.reports.append(
                run_loop(arm, player, hz=HZ, instruction="go", recorder=recorder, until=over.is_set)
            )
        )
        thread.start()
        try:
            wait_for(lambda: arm.commanded, 30)
            yield robot
        finally:
            over.set()
            thread.join()
            player.close()


@pytest.fixture(scope="module")
def server() -> Iterator[LiveServer]:
    with live_server(Going()) as one:
        yield one


@contextmanager
def moving(server: LiveServer, robot: Driven, x: float = -1.0) -> Iterator[RemoteHuman]:
    with remote_human(server.port, robot.agent.session) as human:
        human.move(x)
        yield human


def test_a_second_is_recorded_with_both_actions_and_the_policy_goes_on_without_a_jump(
    server: LiveServer, tmp_path: Path
) -> None:
    recorder = Recorder(tmp_path, HZ, frames=100_000, interventions=True)
    with recorder, driven(server, recorder=recorder) as robot, moving(server, robot) as human:
        leader = robot.leader
        assert leader is not None

        def give_back() -> None:
            if robot.led >= HZ and human.over is None:
                human.release()
                wait_for(lambda: leader.by is None, 30)
                robot.arm.after = lambda: None

        robot.arm.after = give_back
        assert human.ended() == "given back"
        wait_for(lambda: robot.state == "autonomous", 30)
        given_back = monotonic()
        wait_for(lambda: robot.arm.moved_since(given_back), 30)
    seen = pq.read_table(tmp_path / "data/chunk-000/file-000.parquet").to_pydict()
    led = [i for i, human_moves in enumerate(seen["intervention"]) if human_moves]
    assert 49 <= len(led) <= 51
    assert led == list(range(led[0], led[0] + len(led)))
    assert robot.reports[0].interventions == len(led)
    executed, wanted = (np.array([seen[name][i] for i in led]) for name in ("action", "policy_action"))
    known = [seen["policy_known"][i] and not seen["safe"][i] for i in led]
    assert sum(known) > len(led) / 2
    assert (wanted[known, 0] > executed[known, 0]).all(), "the policy wants to go the other way"
    path = np.stack([np.zeros(2), *(action for _, action in robot.arm.commanded)])
    assert np.abs(np.diff(path, axis=0)).max() <= MAX_STEP + 1e-6


def test_when_the_network_is_cut_the_robot_holds_within_the_deadline_and_is_paused(
    server: LiveServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(remote, "SILENT_S", 1.0)
    with (
        closing(CuttableLink(server.port)) as link,
        driven(server, port=link.port) as robot,
        moving(server, robot),
    ):
        deadline_s = 0.3
        link.cut.set()
        cut = monotonic()
        wait_for(lambda: robot.state == "paused", 30)
        assert not robot.arm.moved_since(cut + 2 * deadline_s), "by 0.3 s, if the machine is not busy"
        assert "no command came" in str(robot.player.takeover.reason)


def test_a_page_that_goes_without_giving_back_leaves_the_robot_paused(server: LiveServer) -> None:
    with driven(server) as robot:
        with moving(server, robot):
            pass
        wait_for(lambda: robot.state == "paused", 30)
        assert "the page has gone" in str(robot.player.takeover.reason)
        with moving(server, robot, 1.0) as human:  # a pause that nobody at the robot asked for
            assert robot.state == "human"
            human.release()
            assert human.ended() == "given back"
        wait_for(lambda: robot.state == "autonomous", 30)


def test_a_pause_at_the_robot_is_told_to_the_human(server: LiveServer) -> None:
    with driven(server) as robot, moving(server, robot) as human:
        robot.player.takeover.pause("hands off")
        assert human.ended() == "hands off"
        with remote_human(server.port, robot.agent.session) as again:
            assert again.ended() == "hands off"
        assert robot.state == "paused"


def test_one_human_at_a_time_and_viewers_see_who(server: LiveServer) -> None:
    with driven(server) as robot, server.viewer() as viewer:
        wait_for(lambda: seen(viewer).get(robot.agent.session) == {"by": None}, 30)
        with moving(server, robot) as human:
            wait_for(lambda: seen(viewer).get(robot.agent.session) == {"by": ""}, 30)
            with remote_human(server.port, robot.agent.session) as other:
                assert "somebody moves this robot" in other.ended()
            assert human.over is None
            human.release()
            assert human.ended() == "given back"
        with moving(server, robot) as next_one:
            assert next_one.over is None
    wait_for(lambda: not server.view.robots.describe(), 30)


def seen(viewer: Any) -> dict[str, Any]:
    found: dict[str, Any] = ask(viewer)[0]["replicas"][-1]["robots"]
    return found


def test_a_silent_human_makes_room(server: LiveServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(robot_links, "SILENT_S", 0.3)
    with driven(server) as robot, moving(server, robot) as human:
        human.silent = True
        assert "nothing came" in human.ended()
        with moving(server, robot) as other:
            assert other.over is None


def test_a_robot_that_has_not_opted_in_is_moved_by_nobody(server: LiveServer) -> None:
    with driven(server, offered=False) as robot:
        with remote_human(server.port, robot.agent.session) as human:
            assert "RemoteLeader" in human.ended()
        assert robot.state == "autonomous"


def test_the_robots_command_offers_it_where_it_is_told_to(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(METADATA, "contract", CONTRACT.to_json())
    options = ["--baseline", "0", "--seconds", "60", "--operate", "--remote", "--step", str(STEP)]
    with live_server(Going()) as server:
        thread = threading.Thread(target=main, args=([server.url, *options],))
        thread.start()
        wait_for(lambda: server.view.robots.describe().keys() & set(server.engine.sessions.ids()), 30)
        [session] = server.engine.sessions.ids()
        with remote_human(server.port, session) as human:
            human.move(1.0)
            server.view.commands.press(session, "success", "", "")
            thread.join(30)
    found = re.search(r"ticks at which a human moved the robot: (\d+)", capsys.readouterr().out)
    assert found is not None
    assert int(found[1]) > 0


@pytest.mark.parametrize("message", [{"session": 3}, {"axes": []}, []])
def test_a_malformed_first_message_ends_it(server: LiveServer, message: object) -> None:
    with closing(open_websocket(f"ws://127.0.0.1:{server.port}/v1/live/control", Credentials(""), 10)) as socket:
        socket.send(json.dumps(message).encode(), 10)
        assert json.loads(socket.recv(10))["code"] == "malformed"


def test_a_malformed_command_ends_the_hold_and_leaves_the_robot_paused(server: LiveServer) -> None:
    with driven(server) as robot, moving(server, robot) as human:
        human.axes = [7.0] * 6
        assert human.ended() == "malformed"
        wait_for(lambda: robot.state == "paused", 30)


@pytest.mark.parametrize("message", [{}, {"session": "a", "beat": "1", "hold": "", "why": "", "ended": ["", ""]}, []])
def test_a_malformed_beat_ends_the_robots_connection(server: LiveServer, message: object) -> None:
    with closing(open_websocket(f"ws://127.0.0.1:{server.port}{ROBOT_PATH}", Credentials(""), 10)) as socket:
        socket.send(json.dumps(message).encode(), 10)
        assert json.loads(socket.recv(10))["code"] == "malformed"


def test_a_server_open_to_the_network_moves_no_robot() -> None:
    with live_server(insecure=True) as server:
        for path in ("/v1/live/control", ROBOT_PATH):
            with pytest.raises(Forbidden, match="--insecure"):
                open_websocket(f"ws://127.0.0.1:{server.port}{path}", Credentials(""), 10)


def test_it_wants_the_scope_and_is_logged_and_ends_with_the_key(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(api_keys, "_CHECK_S", 0.0)
    keys = ChangingKeys()
    plain, lab = keys.add("plain"), keys.add("lab", scopes=["watch", "operate"])
    with live_server(Going(), keys=keys.keys) as server, driven(server, plain) as robot:
        session = f"plain/{robot.agent.session}"
        for key, refusal in (("", Unauthorized), (plain, Forbidden)):
            with pytest.raises(refusal), remote_human(server.port, session, key):
                pass
        with caplog.at_level(logging.INFO, "vlagents_ray.serve.audit"):
            with remote_human(server.port, session, lab) as human:
                human.move(1.0)
                assert robot.leader is not None
                assert robot.leader.by == "lab"
                with remote_human(server.port, session, lab) as other:
                    assert other.ended().startswith("lab moves this robot")
                keys.change("lab", scopes=["watch"])
                assert human.ended() == "forbidden"
            wait_for(lambda: robot.state == "paused", 30)
        pressed = [line for line in caplog.messages if "take over" in line]
        assert pressed[0] == f"key lab: pressed 'take over' for session {session!r}"
        assert pressed[1].startswith(f"key lab: pressed 'take over' for session {session!r}: over, key 'lab'")


def test_a_key_offers_no_robot_of_another_key(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(api_keys, "_CHECK_S", 0.0)
    keys = ChangingKeys()
    one, other = keys.add("one"), keys.add("other")
    with live_server(Going(), keys=keys.keys) as server, RemoteAgent(server.url, api_key=one) as agent:
        address = f"ws://127.0.0.1:{server.port}{ROBOT_PATH}"
        with closing(open_websocket(address, Credentials(other), 10)) as socket:
            beat = {"session": agent.session, "beat": 1, "hold": "", "why": "", "ended": ["", ""]}
            socket.send(json.dumps(beat).encode(), 10)
            assert json.loads(socket.recv(10)) == {}
            assert list(server.view.robots.describe()) == [f"other/{agent.session}"]


def test_the_keys_of_the_page_are_those_of_the_terminal() -> None:
    html, _ = live_page()
    table = html[html.index("const MOVES") : html.index("const PULSE_MS")]
    moves = {key: (int(axis), int(sign)) for key, axis, sign in re.findall(r'\["(\w)", (\d), (-?1), ', table)}
    assert moves == keyboard.AXES
