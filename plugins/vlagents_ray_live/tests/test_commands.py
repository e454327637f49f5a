"""Tests of commands from the live page to sessions: the permissions of callers, and the
outcomes.
"""

from __future__ import annotations

import itertools
import json
import logging
import threading
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from eval_fakes import Clock, wait_for
from in_flight import opened
from in_memory_keys import ChangingKeys
from live_server import LiveServer, ask, live_server

from vlagents_ray import Obs, RemoteAgent
from vlagents_ray.chunking.player import ChunkPlayer, PlayerSettings
from vlagents_ray.cli.robot import main
from vlagents_ray.client.commands import COMMAND, COMMANDED, CommandInbox
from vlagents_ray.errors import InvalidInput, Overloaded, UnknownSession
from vlagents_ray.interface import Act, Agent
from vlagents_ray.policies.noop import Noop
from vlagents_ray.protocol.messages import Reply, Request
from vlagents_ray.robot.loop import LoopOptions, LoopReport, run_loop
from vlagents_ray.serve.access import api_keys
from vlagents_ray.serve.sessions import SessionTable
from vlagents_ray_live import live_page
from vlagents_ray_live.commands import CommandBoard, episode_of


class Board:
    """A board with the session "arm"."""

    def __init__(self) -> None:
        self.clock = Clock()
        self.sessions: SessionTable[Any] = SessionTable(10, 60.0)
        opened(self.sessions, "arm")
        self.board = CommandBoard(self.sessions, clock=self.clock)

    def press(self, do: str, episode: str | None = None) -> str:
        return str(self.board.press("arm", do, "lab", episode)["id"])

    @property
    def episode(self) -> str:
        return episode_of(self.sessions.get("arm"))

    def begin_episode(self) -> None:
        self.sessions.get("arm").first += 1

    def answered(self, **info: Any) -> dict[str, Any] | None:
        """Answer a request with this info, and return the command in the answer."""
        self.board.read_outcomes("arm", Request("act", Obs(info=info)))
        reply = Reply(act=Act(np.zeros(2, np.float32)))
        self.board.send("arm", reply)
        found: dict[str, Any] | None = reply.act.info.get(COMMAND) if reply.act else None
        return found

    @property
    def states(self) -> list[str]:
        return [one["state"] for one in self.board.describe("arm")]


@pytest.fixture
def board() -> Board:
    return Board()


def test_a_command_goes_into_one_answer_and_the_next_request_says_what_became_of_it(
    board: Board,
) -> None:
    assert board.answered() is None
    first, second = board.press("pause"), board.press("success")
    assert board.answered() == {"id": first, "do": "pause", "by": "lab"}
    assert board.states == ["sent", "waiting"]
    assert board.answered(**{COMMANDED: {first: ""}}) == {
        "id": second,
        "do": "success",
        "by": "lab",
    }
    assert board.answered(**{COMMANDED: {second: "no hands"}}) is None
    assert board.states == ["done", "refused"]
    assert board.board.describe("arm")[1]["why"] == "no hands"


def test_a_robot_that_does_not_answer_ignores_it(board: Board) -> None:
    pressed = board.press("pause")
    for _ in range(4):
        board.answered()
    assert board.states == ["ignored"]
    board.answered(**{COMMANDED: {pressed: ""}})  # the robot was only slow
    assert board.states == ["done"]


def test_a_command_that_waited_for_too_long_never_reaches_the_robot(board: Board) -> None:
    board.press("pause")
    board.clock.now += 6.0
    assert board.answered() is None
    assert board.states == ["too late"]


@pytest.mark.parametrize("do", ["success", "failure"])
def test_a_mark_is_never_sent_in_another_episode(board: Board, do: str) -> None:
    shown = board.episode
    board.press(do)
    board.begin_episode()
    board.press(do, shown)  # the page still showed the earlier episode
    assert board.answered() is None
    assert board.states == ["too late", "too late"]
    [why] = {press["why"] for press in board.board.describe("arm")}
    assert why == "its episode has ended"
    pressed = board.press(do, board.episode)
    assert board.answered() == {"id": pressed, "do": do, "by": "lab"}


@pytest.mark.parametrize("do", ["stop", "pause"])
def test_what_holds_a_robot_is_also_sent_in_the_next_episode(board: Board, do: str) -> None:
    pressed = board.press(do)
    board.begin_episode()
    assert board.answered() == {"id": pressed, "do": do, "by": "lab"}


@pytest.mark.parametrize(
    "do", ["resume", "instruct", "take over", "restart", "dance", "", "x" * 10_000]
)
def test_what_would_make_a_robot_move_is_refused_with_the_cure(board: Board, do: str) -> None:
    with pytest.raises(InvalidInput, match="at the robot") as refused:
        board.press(do)
    assert "do: expected one of ['pause', 'stop', 'success', 'failure'," in str(refused.value)
    assert board.answered() is None


def test_a_stop_is_accepted_however_many_commands_wait(board: Board) -> None:
    with pytest.raises(UnknownSession):
        board.board.press("leg", "pause", "")
    for _ in range(5):
        board.press("pause")
    with pytest.raises(Overloaded):
        board.press("pause")
    stop = board.press("stop")
    said = board.answered()
    assert said["id"] == stop


def test_ended_sessions_are_forgotten(board: Board) -> None:
    board.press("pause")
    board.board.forget_others([])
    assert board.states == []


def post(
    server: LiveServer, stated: object, key: str = "", **headers: str
) -> tuple[int, dict[str, Any]]:
    data = stated if isinstance(stated, bytes) else json.dumps(stated).encode()
    given = {"content-type": "application/json", **headers} | (
        {"authorization": f"Bearer {key}"} if key else {}
    )
    request = urllib.request.Request(f"{server.url}/v1/live/command", data, given)
    try:
        with urllib.request.urlopen(request, timeout=10) as answer:
            return answer.status, json.load(answer)
    except urllib.error.HTTPError as refused:
        return refused.code, json.load(refused)


class Arm:
    """A robot that counts its actions and stops."""

    simulated = True

    def __init__(self) -> None:
        self.applied = 0
        self.stops = 0

    def observe(self) -> Obs:
        return Obs(state={"joints": np.zeros(2, np.float32)})

    def apply(self, action: np.ndarray) -> None:
        self.applied += 1

    def stop(self) -> None:
        self.stops += 1


@contextmanager
def robot(server: LiveServer, *, obeys: bool = True) -> Iterator[tuple[Arm, str, list[LoopReport]]]:
    """Yield a robot that the server controls, the name of its session, and the reports of its
    loop.
    """
    arm, over, reports = Arm(), threading.Event(), []
    commands = CommandInbox() if obeys else None
    with RemoteAgent(server.url, commands=commands) as agent:
        player = ChunkPlayer(agent, PlayerSettings(mode="async", deadline_s=0.01, safe="hold"))
        thread = threading.Thread(
            target=lambda: reports.append(
                run_loop(
                    arm,
                    player,
                    hz=100,
                    instruction="hold",
                    until=over.is_set,
                    options=LoopOptions(commands=commands),
                )
            )
        )
        thread.start()
        try:
            wait_for(lambda: arm.applied, 30)
            [session] = server.engine.sessions.ids()
            yield arm, session, reports
        finally:
            over.set()
            thread.join()
            player.close()


@pytest.fixture(scope="module")
def server() -> Iterator[LiveServer]:
    with live_server(Noop.from_config({"action_dim": 7, "chunk": 8})) as one:
        yield one


def states(server: LiveServer, session: str) -> list[str]:
    return [f"{one['do']} {one['state']}" for one in server.view.commands.describe(session)]


def test_a_robot_pauses_and_is_marked(server: LiveServer) -> None:
    with robot(server) as (arm, session, reports):
        assert post(server, {"session": session, "do": "pause"})[0] == 200
        wait_for(lambda: states(server, session) == ["pause done"], 30)
        wait_for(lambda: arm.stops, 30)
        assert post(server, {"session": session, "do": "success"})[0] == 200
        wait_for(lambda: reports, 30)
        assert reports[0].outcome == "success"


TICKS = 4  # ticks of an episode


class PressingAgent(Agent):
    """A remote policy, during whose episodes an operator presses a button once.

    Args:
        agent: The remote policy.
        press: Presses the button.
        moment: The number of the call before which it is pressed; half a call later it is pressed
            after the call.
        late: The number of the call whose answer is withheld until `run_over`.
    """

    def __init__(
        self, agent: RemoteAgent, press: Callable[[], None], moment: float, late: int | None
    ) -> None:
        self._agent, self._press, self._moment, self._late = agent, press, moment, late
        self._calls = 0
        self.run_over = threading.Event()

    def reset(self, obs: Obs, instruction: str | None = None, **kwargs: Any) -> dict[str, Any]:
        with self._call():
            return self._agent.reset(obs, instruction, **kwargs)

    def act(self, obs: Obs) -> Act:
        with self._call():
            return self._agent.act(obs)

    @contextmanager
    def _call(self) -> Iterator[None]:
        number, self._calls = self._calls, self._calls + 1
        if self._moment == number:
            self._press()
        if number == self._late:
            self.run_over.wait(10)
        yield
        if self._moment == number + 0.5:
            self._press()


@pytest.mark.parametrize("late", [None, TICKS - 1, TICKS])
@pytest.mark.parametrize("moment", [half / 2 for half in range(1, 4 * (TICKS + 1))])
def test_a_mark_is_of_the_episode_in_which_it_was_pressed(
    server: LiveServer, moment: float, late: int | None
) -> None:
    commands = CommandInbox()
    pressed: list[int] = []
    outcomes: list[str] = []
    with RemoteAgent(server.url, commands=commands) as remote:

        def press() -> None:
            session = server.engine.sessions.get(remote.session)
            server.view.press(session.id, "success", "lab", episode_of(session))
            is_first = not episodes or episodes[0] == episode_of(session)
            pressed.append(0 if is_first else 1)

        episodes: list[str] = []  # the episodes of the runs that have ended
        pressing = PressingAgent(remote, press, moment, late)
        settings = PlayerSettings(mode="async", safe="hold")
        if late is None:
            settings = PlayerSettings(execute=1)
        with ChunkPlayer(pressing, settings) as player:
            for _ in range(2):
                ticks = itertools.count()
                report = run_loop(
                    Arm(),
                    player,
                    hz=100,
                    until=lambda ticks=ticks: next(ticks) >= TICKS,  # type: ignore[misc]
                    options=LoopOptions(commands=commands),
                )
                outcomes.append(report.outcome)
                episodes.append(episode_of(server.engine.sessions.get(remote.session)))
                pressing.run_over.set()
    for episode, outcome in enumerate(outcomes):
        assert not outcome or pressed == [episode], (outcomes, pressed)


def test_nothing_moves_while_it_is_paused_whatever_comes_over_the_network(
    server: LiveServer,
) -> None:
    with robot(server) as (arm, session, reports):
        post(server, {"session": session, "do": "pause"})
        wait_for(lambda: states(server, session) == ["pause done"], 30)
        applied = arm.applied
        for do in ("resume", "instruct"):
            status, said = post(server, {"session": session, "do": do, "text": "go on"})
            assert (status, "at the robot" in said["detail"]) == (400, True)
        steps = server.engine.sessions.get(session).steps
        # The policy continues to answer.
        wait_for(lambda: server.engine.sessions.get(session).steps > steps + 10, 30)
        assert (arm.applied, reports) == (applied, [])


def test_a_marked_episode_ends_the_robots_command(
    server: LiveServer, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["--hz", "50", "--seconds", "30", "--instruction", "fold", "--allow-remote-stop"]
    status: list[int] = []
    thread = threading.Thread(target=lambda: status.append(main([server.url, *options])))
    thread.start()
    wait_for(lambda: [one.instruction for one in server.engine.sessions.all()] == ["fold"], 30)
    [session] = server.engine.sessions.ids()
    assert post(server, {"session": session, "do": "failure"})[0] == 200
    thread.join(30)
    assert status in ([0], [1])  # the status is 1 if safe actions were used while it connected
    assert "marked as a failure" in capsys.readouterr().out


def test_a_robot_that_has_not_opted_in_goes_on(server: LiveServer) -> None:
    with robot(server, obeys=False) as (arm, session, _):
        post(server, {"session": session, "do": "stop"})
        wait_for(lambda: states(server, session) == ["stop ignored"], 30)
        applied = arm.applied
        wait_for(lambda: arm.applied > applied, 30)
        assert arm.stops == 0


def test_viewers_see_the_commands_and_whether_they_may_give_some(server: LiveServer) -> None:
    with RemoteAgent(server.url) as agent, server.viewer() as viewer:
        agent.reset(Obs())
        [session] = server.engine.sessions.ids()
        post(server, {"session": session, "do": "pause"})
        shown: list[dict[str, Any]] = []
        while not shown or not shown[0]["commands"]:  # the first data may precede the command
            document, _ = ask(viewer)
            assert document["may_operate"] is True
            shown = document["replicas"][-1]["sessions"]
        assert [(one["do"], one["state"]) for one in shown[0]["commands"]] == [("pause", "waiting")]


@pytest.mark.parametrize(
    "body", [b"", b"[]", b"{", b'{"session": 1, "do": "stop"}', b'{"do": "stop"}', b"[" * 10_000]
)
def test_malformed_commands_are_refused(server: LiveServer, body: bytes) -> None:
    assert post(server, body)[0] == 400


def test_a_long_command_is_not_read(server: LiveServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_page, "_COMMAND_BYTES", 100)
    assert post(server, {"session": "x" * 200, "do": "stop"})[0] == 413


@pytest.mark.parametrize(
    "headers",
    [
        {"origin": "http://evil.example"},
        {"origin": "null"},
        {"host": "evil.example"},
        {"content-type": "text/plain"},
    ],
)
def test_another_sites_page_cannot_press(server: LiveServer, headers: dict[str, str]) -> None:
    with RemoteAgent(server.url) as agent:
        agent.reset(Obs())
        [session] = server.engine.sessions.ids()
        assert post(server, {"session": session, "do": "stop"}, **headers)[0] in (400, 403)
        assert states(server, session) == []


def test_a_server_open_to_the_network_accepts_no_command() -> None:
    with live_server(insecure=True) as server:
        status, said = post(server, {"session": "x", "do": "stop"})
        assert status == 403
        assert "--scope operate" in said["detail"]


def test_a_key_needs_the_scope_and_each_press_is_logged(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(api_keys, "_CHECK_S", 0.0)
    keys = ChangingKeys()
    watching, operating = (
        keys.add("watching", scopes=["watch"]),
        keys.add("lab", scopes=["watch", "operate"]),
    )
    with live_server(keys=keys.keys) as server, RemoteAgent(server.url, api_key=watching) as agent:
        agent.reset(Obs())
        [session] = server.engine.sessions.ids()
        pause = {"session": session, "do": "pause"}
        assert post(server, pause, watching)[0] == 403
        for key, may in ((watching, False), (operating, True)):
            with server.viewer(key) as viewer:
                assert ask(viewer)[0]["may_operate"] is may
        with caplog.at_level(logging.INFO, "vlagents_ray.serve.audit"):
            for _ in range(2):
                assert post(server, pause, operating)[1]["by"] == "lab"
        assert caplog.messages.count(f"key lab: pressed 'pause' for session {session!r}") == 2
