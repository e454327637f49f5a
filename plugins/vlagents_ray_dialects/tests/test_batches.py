"""A message with several observations acts on all of them, or on none: each stage fails for each
observation in turn, with and without earlier sessions.

After an error the server has the same sessions as before, and the repeated message finds all its
sessions at the same step.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import threading
from collections.abc import Callable, Coroutine, Iterator
from typing import Any, NamedTuple

import numpy as np
import pytest
from dialect_server import (
    ALL,
    LIMITS,
    client_of,
    image,
    serving,
    xpolicylab,
    xpolicylab_observation,
)
from in_process_replicas import Replicas

from vlagents_ray import Act, Agent, Obs
from vlagents_ray.contract import CameraSpec, Contract
from vlagents_ray.errors import InvalidObservation, PolicyFailed
from vlagents_ray.protocol.messages import Budget, Reply
from vlagents_ray.serve.access.api_keys import NoKey
from vlagents_ray.serve.access.charges import free
from vlagents_ray.serve.dialects import base
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.sender import Sender
from vlagents_ray.serve.engine.settings import EngineSettings
from vlagents_ray.serve.requests import IncomingMessage
from vlagents_ray_dialects.messages import openpi
from vlagents_ray_dialects.messages import xpolicylab as xpolicylab_codec

PATH = "/v1/actions/generations"
MSGPACK = {"content-type": "application/msgpack"}
ROBOTS = 3


class Faulty(Agent):
    """A policy whose action is the number of the act in its episode, and which fails once, in the
    stage and for the pixel in `fault`.
    """

    contract = Contract(cameras={"front": CameraSpec(height=8, width=8)})
    fault: tuple[str, int] | None = None

    def reset(self, obs: Obs, instruction: str | None, **kwargs: object) -> dict[str, Any]:
        self.acts = 0
        self._fail("reset", obs)
        return {}

    def act(self, obs: Obs) -> Act:
        self._fail("act", obs)
        self.acts += 1
        width = 2 if self._is_due("answer", obs) else 1
        return Act(np.full((1, width), self.acts, np.float32))

    def _fail(self, stage: str, obs: Obs) -> None:
        if self._is_due(stage, obs):
            raise InvalidObservation("front: too dark")

    @staticmethod
    def _is_due(stage: str, obs: Obs) -> bool:
        if Faulty.fault != (stage, int(obs.cameras["front"][0, 0, 0])):
            return False
        Faulty.fault = None
        return True


@pytest.fixture(autouse=True)
def no_fault() -> Iterator[None]:
    Faulty.fault = None
    yield
    Faulty.fault = None


class Refused(Exception):
    """The message was answered with an error."""


# Acts on the images of several robots, and returns the number of each robot's acts.
ActOnAll = Callable[[list[np.ndarray]], list[int]]


def over_sglang(client: Any, *, named: bool) -> ActOnAll:
    def act(images: list[np.ndarray]) -> list[int]:
        names = {"session_ids": [f"slot-{i}" for i in range(len(images))]} if named else {}
        observation = {
            "images": {"front": np.stack(images)},
            "state": np.zeros((len(images), 2), np.float32),
        }
        payload = {
            "input": {"prompt": ["task"] * len(images), "observation": observation},
            "parameters": {"action_dim": 1, **names},
        }
        response = client.post(PATH, content=openpi.encode(payload), headers=MSGPACK)
        if response.status_code != 200:
            raise Refused(response.text)
        actions: list[int] = []
        for entry in openpi.decode(response.content)["data"]:
            actions += map(int, np.ravel(entry["action"]["values"]))
        return actions

    return act


def over_xpolicylab(socket: Any) -> ActOnAll:
    numbers = itertools.count()

    def call(method: str, obs: Any) -> Any:
        message = xpolicylab("call", f"m-{next(numbers)}", func_name=method, obs=obs)
        socket.send_bytes(message)
        answer = xpolicylab_codec.decode(socket.receive_bytes(), Budget(LIMITS))
        if answer.kind == "error":
            raise Refused(answer.payload["message"])
        return answer.payload.get("result")

    def act(images: list[np.ndarray]) -> list[int]:
        observations = []
        for index, picture in enumerate(images):
            vision = {"cam_head": {"color": picture}}
            observations.append(xpolicylab_observation(0, env_idx=index) | {"vision": vision})
        call("update_obs_batch", observations)
        chunks = call("get_action_batch", list(range(len(images))))
        return [int(chunk[0]["actions"][0]) for chunk in chunks]

    return act


def over_gr00t(port: int, close: contextlib.ExitStack) -> ActOnAll:
    pytest.importorskip("zmq")
    from gr00t_client import PolicyClient

    client = PolicyClient(port)
    close.callback(client.close)

    def act(images: list[np.ndarray]) -> list[int]:
        number = len(images)
        observation = {
            "video": {"front": np.stack(images)[:, None]},
            "state": {"arm": np.zeros((number, 1, 2), np.float32)},
            "language": {"task": [["go"]] * number},
        }
        try:
            actions, _ = client.get_action(observation)
        except RuntimeError as error:
            raise Refused(str(error)) from error
        return [int(value) for value in np.ravel(actions["action"])]

    return act


class Served(NamedTuple):
    """A dialect whose messages have several observations."""

    act: ActOnAll
    ids: Callable[[], set[str]]  # returns the ids of the server's sessions


DIALECTS = ("sglang", "sglang without names", "xpolicylab", "gr00t")


@contextlib.contextmanager
def served(dialect: str, open_dialect: Any, replicas: Replicas) -> Iterator[Served]:
    if dialect == "gr00t":
        with contextlib.ExitStack() as close:
            act = over_gr00t(open_dialect("gr00t"), close)
            yield Served(act, lambda: set(replicas.engines[0].sessions.ids()))
        return

    settings = ALL | {
        "xpolicylab": {"mapping": {"preset": "xpolicylab", "action": {"actions": {}}}}
    }
    with serving(Faulty(), settings, session_limit=8) as (client, engine):
        ids = lambda: set(engine.sessions.ids())  # noqa: E731
        if dialect != "xpolicylab":
            yield Served(over_sglang(client, named=dialect == "sglang"), ids)
            return
        with client.websocket_connect("/xpolicylab") as socket:
            yield Served(over_xpolicylab(socket), ids)


@pytest.fixture(name="replicas")
def replicas_of_faulty() -> Iterator[Replicas]:
    replicas = Replicas([Faulty()], session_limit=8)
    yield replicas
    replicas.close()


@pytest.mark.parametrize("before", [0, 2], ids=["new sessions", "running sessions"])
@pytest.mark.parametrize("dialect", DIALECTS)
def test_a_failed_batch_leaves_the_sessions_and_their_steps_alike(
    dialect: str, before: int, open_dialect: Any, replicas: Replicas
) -> None:
    images = [image(index + 1) for index in range(ROBOTS)]
    stages = ["reset", "act"] + ["answer"] * dialect.startswith("sglang")
    for stage, failing in itertools.product(stages, range(ROBOTS)):
        with served(dialect, open_dialect, replicas) as (act, ids):
            for number in range(before):
                assert act(images) in ([number + 1] * ROBOTS, [1] * ROBOTS)
            held = ids()

            Faulty.fault = stage, failing + 1
            fails = stage != "reset" or not before or dialect == "sglang without names"
            if fails:
                with pytest.raises(Refused, match=r"too dark|action_dim"):
                    act(images)
                assert ids() == held, (stage, failing)
            Faulty.fault = None
            steps = act(images)
            assert steps == [steps[0]] * ROBOTS, (stage, failing)
            if fails:
                assert steps[0] == 1, "an observation that was refused had an effect"
        if dialect == "gr00t":
            from eval_fakes import wait_for

            wait_for(lambda: not replicas.engines[0].sessions.ids())


@pytest.mark.parametrize("failing", range(ROBOTS))
def test_an_observation_that_the_contract_rejects_stops_the_others_before_they_act(
    failing: int, open_dialect: Any, replicas: Replicas
) -> None:
    images = [image(index + 1) for index in range(ROBOTS)]
    images[failing] = np.zeros((9, 8, 3), np.uint8)
    with served("xpolicylab", open_dialect, replicas) as (act, ids):
        with pytest.raises(Refused, match="front"):
            act(images)
        assert not ids()
        good = [image(1)] * ROBOTS
        assert [act(good), act(good)] == [[1] * ROBOTS, [2] * ROBOTS]
        with pytest.raises(Refused, match="front"):
            act(images)
        assert act(good) == [3] * ROBOTS, "the running episodes were ended"


# A connection of XPolicyLab ends with this error, and its sessions with it.
@pytest.mark.parametrize("dialect", [name for name in DIALECTS if name != "xpolicylab"])
def test_a_batch_without_room_begins_no_session(
    dialect: str, open_dialect: Any, replicas: Replicas
) -> None:
    with served(dialect, open_dialect, replicas) as (act, ids):
        for number in (9, 12):
            with pytest.raises(Refused, match="8 sessions"):
                act([image(1)] * number)
            assert not ids()
        assert act([image(1)] * 8) == [1] * 8


def test_an_error_of_all_observations_ends_no_running_episode(
    open_dialect: Any, replicas: Replicas
) -> None:
    class Down(Faulty):
        def act_batch(self, obs: Any, sessions: Any) -> Any:
            if Faulty.fault is not None:
                Faulty.fault = None
                raise PolicyFailed("the device is gone")
            return super().act_batch(obs, sessions)

    images = [image(1)] * ROBOTS
    with serving(Down(), ALL) as (client, _):
        act = over_sglang(client, named=True)
        assert act(images) == [1] * ROBOTS
        Faulty.fault = "batch", 1
        with pytest.raises(Refused, match="the device is gone"):
            act(images)
        assert act(images) == [2] * ROBOTS


def test_all_names_of_a_batch_are_searched_for_at_once() -> None:
    replicas = Replicas([Faulty(), Faulty()])
    searches: list[str] = []
    finder = replicas.migrators[0]
    fetch = finder.fetch

    def counted(session_id: str, *args: Any, **kwargs: Any) -> bool:
        searches.append(session_id)
        assert answered == [], "a search began after another had ended"
        then = args[0]
        return fetch(session_id, lambda: (answered.append(session_id), then()), *args[1:], **kwargs)

    answered: list[str] = []
    finder.fetch = counted  # type: ignore[method-assign]
    try:
        with client_of(replicas.engines[0], ALL) as client:
            assert over_sglang(client, named=True)([image(1)] * 8) == [1] * 8
        assert len(searches) == 8
    finally:
        replicas.close()


class Waiting(Agent):
    """A policy that counts its acts, and waits for `opened` at an observation that asks for it."""

    opened, entered = threading.Event(), threading.Event()

    def reset(self, obs: Obs, instruction: str | None, **kwargs: object) -> dict[str, Any]:
        self.acts = 0
        return {}

    def act(self, obs: Obs) -> Act:
        if "wait" in obs.info:
            self.entered.set()
            assert self.opened.wait(60)
        self.acts += 1
        return Act(np.full((1, 1), self.acts, np.float32))


@pytest.mark.parametrize("before", [0, 2], ids=["new sessions", "running sessions"])
@pytest.mark.parametrize("waiting", range(ROBOTS))
def test_a_batch_whose_client_leaves_leaves_the_sessions_alike(waiting: int, before: int) -> None:
    engine = Engine(Waiting(), EngineSettings())
    engine.start()
    sender = Sender(engine, "test", "a", caller=NoKey.OPEN, has_left=None, connected=False)
    group = [base.ImplicitSession(engine, sender, "robot", name) for name in ("a", "b", "c")]

    def act(waits: int | None = None) -> Coroutine[Any, Any, list[Reply]]:
        observations = []
        for index, session in enumerate(group):
            info = {"wait": True} if index == waits else {}
            obs = Obs(state={"joints": np.zeros(2, np.float32)}, info=info)
            observations.append(base.SessionObs(session, obs, None))
        message = IncomingMessage("test", "act", "robot", free(NoKey.OPEN))
        return base.act_together(message, observations, "r")

    async def run() -> None:
        for _ in range(before):
            await act()
        held = engine.sessions.ids()
        Waiting.opened.clear()
        Waiting.entered.clear()
        leaving = asyncio.ensure_future(act(waiting))
        await asyncio.to_thread(Waiting.entered.wait, 60)
        leaving.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await leaving
        assert engine.sessions.ids() == held
        Waiting.opened.set()

        replies = await act()
        acts = [float(reply.act.action[0, 0]) for reply in replies if reply.act is not None]
        assert acts == [1.0] * ROBOTS

    asyncio.run(run())
    engine.close()
