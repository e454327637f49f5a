"""Tests of the live page in a browser."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import numpy as np
import pytest
from browser import Page, browser
from eval_fakes import wait_for
from in_memory_keys import ChangingKeys
from live_server import Address, LiveServer, ask, live_server

from vlagents_ray import Obs, RemoteAgent
from vlagents_ray.chunking.player import ChunkPlayer, PlayerSettings
from vlagents_ray.client.commands import CommandInbox
from vlagents_ray.contract import ActionSpec, CameraSpec, Contract
from vlagents_ray.errors import PolicyFailed
from vlagents_ray.interface import Act, Agent
from vlagents_ray.policies.noop import Noop
from vlagents_ray.protocol.messages import PriorityName
from vlagents_ray.robot.loop import LoopOptions, LoopReport, run_loop
from vlagents_ray.robot.simulated import SimulatedRobot
from vlagents_ray.serve.access import api_keys

pytestmark = [pytest.mark.browser, pytest.mark.slow]

CARDS = "document.querySelectorAll('article').length"
PICTURES = (
    "[...document.querySelectorAll('article img')].filter((one) => one.naturalWidth === 48).length"
)
STATUS = "document.getElementById('connection').textContent"


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with browser(tmp_path_factory.mktemp("profile")) as opened:
        yield opened


@pytest.fixture(scope="module")
def server() -> Iterator[LiveServer]:
    with live_server(Noop.from_config({"action_dim": 7, "chunk": 8})) as one:
        yield one


def show(
    page: Page, server: LiveServer, *, width: int = 1400, scheme: str = "light", height: int = 900
) -> None:
    page.said.clear()
    page.asked.clear()
    page.open(Address(f"{server.url}/live"), width=width, scheme=scheme, height=height)  # type: ignore[arg-type]


def until(page: Page, expression: str, want: object) -> None:
    """Wait until the expression has this value."""
    wait_for(lambda: page.value(expression) == want, 30)


@contextmanager
def acting(
    server: LiveServer, number: int, priority: PriorityName = "robot", key: str | None = None
) -> Iterator[None]:
    """Run this number of robots or simulations until the end of the context."""
    over = threading.Event()

    def act(index: int) -> None:
        image = np.full((32, 48, 3), 10 * index, np.uint8)
        with RemoteAgent(server.url, priority=priority, api_key=key) as agent:
            obs = Obs({"front": image}, 1.0, {"joints": np.zeros(7, np.float32)})
            agent.reset(obs, f"push cube {index}")
            while not over.wait(0.05):
                obs.state["joints"] = obs.state["joints"] + np.float32(0.01)
                agent.act(obs)

    threads = [threading.Thread(target=act, args=(index,)) for index in range(number)]
    with ExitStack() as stack:
        for thread in threads:
            thread.start()
            stack.callback(thread.join)
        stack.callback(over.set)
        yield


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [360, 1400])
@pytest.mark.parametrize("robots", [0, 1])
def test_it_fits_without_errors_or_requests_outside(
    page: Page, server: LiveServer, robots: int, width: int, scheme: str
) -> None:
    wait_for(lambda: len(server.engine.sessions) == 0, 30)
    with acting(server, robots):
        show(page, server, width=width, scheme=scheme)
        until(page, STATUS, "Live")
        until(page, CARDS, robots)
        until(page, PICTURES, robots)
        assert page.value("document.documentElement.scrollWidth") <= width
        assert page.said == []
        assert [url for url in page.asked if not url.startswith(("blob:", "data:"))] == [
            f"{server.url}/live"
        ]
        assert page.value("document.getElementById('nothing').hidden") == (robots > 0)


def test_a_card_says_what_its_session_does(page: Page, server: LiveServer) -> None:
    with acting(server, 1):
        show(page, server)
        until(page, PICTURES, 1)
        # The plots show state, gripper and plan.
        until(page, "document.querySelectorAll('article polyline').length >= 15", True)
        text = page.value("document.querySelector('article').innerText")
        assert "push cube 0" in text
        assert "robot, websocket" in text
        name = "document.querySelector('article .name')"
        assert len(page.value(f"{name}.title")) == 32
        assert page.value(f"{name}.title.startsWith({name}.textContent.split(',')[0])")
        assert page.value(f"{name}.textContent.indexOf(',')") == 8
        first = (
            "[...document.querySelectorAll('main section')].find((one) => one.checkVisibility())"
        )
        assert page.value(f"{first}.contains(document.querySelector('article'))"), (
            "what happens now comes first"
        )
        assert "plan: 8 rows" in text
        assert page.value("document.querySelectorAll('#fleet tr').length") == 1
        until(page, "document.getElementById('percentiles').innerText.includes(' ms')", True)
    until(page, CARDS, 0)  # the session has ended


class Failing(Agent):
    def reset(self, obs: Obs, instruction: str | None, **kwargs: object) -> dict[str, object]:
        return {}

    def act(self, obs: Obs) -> Act:
        raise RuntimeError("secret")


ORDER = "[...document.querySelectorAll('article')].map((one) => one.dataset.session)"


def test_cards_keep_their_places_as_each_has_a_stop_button(page: Page, server: LiveServer) -> None:
    wait_for(lambda: len(server.engine.sessions) == 0, 30)
    with acting(server, 3):
        show(page, server)
        until(page, CARDS, 3)
        order = page.value(ORDER)
        assert order == sorted(order)
        show(page, server)
        until(page, CARDS, 3)
        assert page.value(ORDER) == order

    # The cards of sessions that have ended stay where they are for a while, without buttons.
    until(page, "document.querySelectorAll('article.silent').length", 3)
    assert page.value(ORDER) == order
    until(page, CARDS, 0)


def test_an_error_is_its_code_until_it_is_unfolded(page: Page) -> None:
    error = "document.querySelector('article .bad')"
    with live_server(Failing()) as server, RemoteAgent(server.url) as agent:
        agent.reset(Obs(), "push cube 0")
        show(page, server)
        until(page, CARDS, 1)
        with pytest.raises(PolicyFailed):
            agent.act(Obs())
        until(page, f"{error}.innerText", "policy_failed")
        page.value(f"{error}.open = true")
        assert "request id" in page.value(f"{error}.innerText")


def test_the_buttons_of_a_robot_are_in_one_row_on_a_phone(page: Page, server: LiveServer) -> None:
    tops = (
        "new Set([...document.querySelectorAll('article .row:first-child button')].map((one) => "
        "one.offsetTop)).size"
    )
    with operated(server):
        show(page, server, width=360)
        until(page, CARDS, 1)
        until(page, tops, 1)


PRESS = (
    "(text) => [...document.querySelectorAll('article button')].find((one) => one.textContent "
    "=== text).click()"
)


@contextmanager
def operated(
    server: LiveServer, key: str | None = None, cameras: int = 0
) -> Iterator[list[LoopReport]]:
    """Yield the reports of a simulated robot that executes commands of the page."""
    specs = {f"camera{number}": CameraSpec(480, 480) for number in range(cameras)}
    commands, over, reports = CommandInbox(), threading.Event(), []
    with RemoteAgent(server.url, api_key=key, commands=commands) as agent:
        robot, player = (
            SimulatedRobot(Contract(cameras=specs, action=ActionSpec(7))),
            ChunkPlayer(agent, PlayerSettings(mode="async", safe="hold")),
        )
        thread = threading.Thread(
            target=lambda: reports.append(
                run_loop(
                    robot,
                    player,
                    hz=50,
                    instruction="wipe the table",
                    until=over.is_set,
                    options=LoopOptions(commands=commands),
                )
            )
        )
        thread.start()
        try:
            yield reports
        finally:
            over.set()
            thread.join()
            player.close()


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [360, 1400])
def test_buttons_act_on_a_session(page: Page, server: LiveServer, width: int, scheme: str) -> None:
    outcome = "document.querySelector('article .operate > [role=status]')?.textContent"
    with operated(server) as reports:
        show(page, server, width=width, scheme=scheme)
        until(page, CARDS, 1)
        page.value(f"({PRESS})('Pause')")
        until(page, outcome, "pause: done")
        assert page.value("document.documentElement.scrollWidth") <= width
        shown = "[...document.querySelectorAll('article button')].map((one) => one.textContent)"
        assert page.value(shown)[:4] == ["Stop", "Pause", "Success", "Failure"]
        page.value(f"({PRESS})('Failure')")
        wait_for(lambda: reports, 30)
        assert reports[0].outcome == "failure"
        assert page.said == []
        outside = [url for url in page.asked if not url.startswith(("blob:", "data:", server.url))]
        assert outside == []


@pytest.mark.parametrize("cameras", [1, 2, 3])
@pytest.mark.parametrize(("width", "height"), [(1280, 800), (1280, 1000), (1024, 600), (360, 740)])
def test_stop_is_in_sight_without_scrolling_whatever_the_cameras(
    page: Page, server: LiveServer, width: int, height: int, cameras: int
) -> None:
    wait_for(lambda: len(server.engine.sessions) == 0, 30)
    loaded = (
        "[...document.querySelectorAll('article img')].filter((one) => one.naturalWidth === "
        "480).length"
    )
    with operated(server, cameras=cameras):
        show(page, server, width=width, height=height)
        until(page, loaded, cameras)
        stop = "document.querySelector('article button.stop').getBoundingClientRect()"
        assert page.value("scrollY") == 0
        assert 0 <= page.value(f"{stop}.top") < page.value(f"{stop}.bottom") <= height
        assert page.value("document.documentElement.scrollWidth") <= width


def test_a_card_of_a_stopped_robot_says_so(page: Page, server: LiveServer) -> None:
    wait_for(lambda: len(server.engine.sessions) == 0, 30)
    stopped = "document.querySelector('article .stopped').checkVisibility()"
    with operated(server):
        show(page, server)
        until(page, CARDS, 1)
        assert page.value(stopped) is False
        page.value(f"({PRESS})('Stop')")
        until(page, stopped, True)
        assert page.value("document.querySelector('article .stopped').textContent").startswith(
            "Stopped by "
        )
        assert page.said == []


def test_it_asks_for_a_key_and_watches_with_one(page: Page) -> None:
    keys = ChangingKeys()
    plain, watching = keys.add("plain"), keys.add("watching", scopes=["watch"])
    with live_server(keys=keys.keys) as server, acting(server, 1, key=plain):
        show(page, server)
        until(page, "document.getElementById('key').hidden", want=False)
        assert page.value("document.querySelector('main').hidden") is True
        for key, told in ((plain, "This key may not watch here"), (watching, "Live")):
            page.value(
                f"(() => {{ document.getElementById('key-text').value = '{key}';"
                "document.querySelector('#key button').click(); })()"
            )
            until(page, STATUS, told)
        until(page, PICTURES, 1)
        assert "plain/" in page.value("document.querySelector('article .name').textContent")


def test_a_key_without_the_scope_sees_no_buttons(
    page: Page, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(api_keys, "_CHECK_S", 0.0)
    keys = ChangingKeys()
    for name, scopes, buttons in (("watching", ["watch"], 0), ("lab", ["watch", "operate"], 4)):
        key = keys.add(name, scopes=scopes)
        with (
            live_server(Noop.from_config({"action_dim": 7}), keys=keys.keys) as server,
            operated(server, key),
        ):
            show(page, server)
            until(page, "document.getElementById('key').hidden", want=False)
            page.value(
                f"(() => {{ document.getElementById('key-text').value = '{key}';"
                "document.querySelector('#key button').click(); })()"
            )
            until(page, STATUS, "Live")
            until(page, CARDS, 1)
            shown = (
                "[...document.querySelectorAll('article button')].filter((one) => "
                "one.checkVisibility()).length"
            )
            until(page, shown, buttons)


def test_it_says_so_when_the_server_is_gone(page: Page) -> None:
    with live_server() as server:
        show(page, server)
        until(page, STATUS, "Live")
    until(page, f"{STATUS} !== 'Live'", want=True)


NO_SOCKET = """
  window.sockets = [];
  window.WebSocket = class {
    constructor() { this.asked = 0; window.sockets.push(this); }
    send() { this.asked++; }
  };
  WebSocket.OPEN = 1;
"""
DELIVER = """((good, changes) => {
  const socket = window.sockets[window.sockets.length - 1], wrong = [];
  const copy = (value) => JSON.parse(JSON.stringify(value));
  let step = 100;
  const deliver = (said) => {
    const text = new TextEncoder().encode(JSON.stringify(said)), asked = socket.asked;
    const data = new ArrayBuffer(4 + text.length);
    new DataView(data).setUint32(0, text.length, true);
    new Uint8Array(data, 4).set(text);
    socket.onmessage({ data });
    return socket.asked === asked + 1;
  };
  const next = (later) => {
    const said = copy(good);
    said.time = good.time += later;
    step++;
    for (const session of said.replicas[0].sessions) session.step = step;
    return said;
  };
  const shows = (id) => [...document.querySelectorAll("article")].map((one) => one.textContent)
    .some((text) => text.includes(id) && text.includes(`step${step}`));
  const live = () => document.getElementById("connection").textContent === "Live";
  socket.onopen();
  for (const [path, removed, value] of changes) {
    const said = next(0.1), keys = copy(path), last = keys.pop(), inside = keys.reduce((part, one) => part[one], said);
    if (removed) delete inside[last]; else inside[last] = value;
    const told = JSON.stringify([path, removed ? "removed" : value]);
    if (!deliver(said)) wrong.push(`${told}: asks for nothing more`);
    const own = path[2] === "sessions" && path.length > 3;
    if (own && !shows("second")) wrong.push(`${told}: another card is not shown`);
    if (!deliver(next(own ? 0.1 : 20)) || !shows("first") || !live())
      wrong.push(`${told}: the next message is not shown`);
  }
  return wrong;
})"""
VALUES = [None, True, -1, 1e300, "", "text", [], [None], [[None]], ["text"], {}, {"a": {}}]


def every_place(value: object, path: tuple[str | int, ...] = ()) -> Iterator[tuple[str | int, ...]]:
    """Yield the path of each value of a document, for lists only of the first element."""
    if path:
        yield path
    parts = (
        value.items()
        if isinstance(value, dict)
        else enumerate(value[:1])
        if isinstance(value, list)
        else ()
    )
    for key, part in parts:
        yield from every_place(part, (*path, key))


def test_a_page_goes_on_whatever_a_message_says(page: Page, server: LiveServer) -> None:
    with operated(server), server.viewer() as viewer:
        session: dict[str, Any] = {}
        while not {"state", "last"} < session.keys():
            said, _ = ask(viewer)
            for one in said["replicas"][0]["sessions"]:
                session = {**session, **one}
    session |= {
        "pictures": {},
        "commands": [{"id": "a-1", "do": "stop", "by": "", "state": "done", "why": ""}],
    }
    said["replicas"][0]["sessions"] = [session | {"id": name} for name in ("first", "second")]
    changes = [
        (list(path), removed, value)
        for path in every_place(said)
        if path[:1] not in (("files",), ("time",)) and path[2:3] != ("name",)
        for removed, value in ((True, None), *((False, value) for value in VALUES))
    ]
    assert len(changes) > 500
    script = page.call("Page.addScriptToEvaluateOnNewDocument", source=NO_SOCKET)["identifier"]
    try:
        show(page, server)
        wrong = page.value(f"{DELIVER}({json.dumps(said)}, {json.dumps(changes)})")
        assert wrong == [], "\n".join(wrong)
    finally:
        page.call("Page.removeScriptToEvaluateOnNewDocument", identifier=script)
