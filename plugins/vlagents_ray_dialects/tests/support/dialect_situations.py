"""The endpoints of the dialects, for the table of `endpoint_situations`.

Each connection is recorded from its first byte. Of LeRobot's connections only the messages are
recorded, as the libraries of gRPC and Zenoh choose the bytes around them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from endpoint_situations import (
    NO_FRAME,
    NO_HTTP,
    PING,
    WRONG_KEY,
    Cost,
    Endpoint,
    finishes,
    handshake,
    websocket_frame,
)
from lerobot_messages import field_of, parts_of, pickled, robot_saw, setup

from tests.golden.dialects import JOINTS, LIBERO, PIXELS, RUBBISH, without
from tests.golden.lines import remote_messages
from tests.golden.masks import masked
from tests.golden.replica import EACH_BYTE, KEY
from tests.golden.scenarios import Send, Steps, asks, gets, http, server
from vlagents_ray_dialects.messages import gr00t, openpi, openvla, vla_eval, vlagents, xpolicylab
from vlagents_ray_dialects.messages.http2 import PREFACE

_NO_DEADLINE = "the protocol has no deadlines"
_NO_KEY = "the protocol has no field for a key"
_SESSION_IS_CONNECTION = "a session is the connection"
NOT_APPLICABLE: dict[str, dict[str, str]] = {
    "openpi": {
        "unknown session": _SESSION_IS_CONNECTION,
        "expired deadline": _NO_DEADLINE,
    },
    "roboarena": {
        "unknown session": "a session is the connection, and any `session_id` begins an episode",
        "expired deadline": _NO_DEADLINE,
    },
    "openvla": {
        "metadata": "the protocol has none",
        "reset": "the protocol has none: each new instruction begins an episode",
        "unknown session": "a session begins with its first request",
        "expired deadline": _NO_DEADLINE,
    },
    "sglang": {
        "reset": "the protocol has none: a request with `reset_mask` or a new prompt begins an "
        "episode",
        "unknown session": "a session begins with its first request",
        "expired deadline": _NO_DEADLINE,
    },
    "sglang_realtime": {
        "reset": "the protocol has none: a request with `reset_mask` or a new prompt begins an "
        "episode",
        "unknown session": "a session begins with its first request",
        "expired deadline": _NO_DEADLINE,
    },
    "vla_eval": {
        "unknown session": _SESSION_IS_CONNECTION,
        "expired deadline": _NO_DEADLINE,
    },
    "xpolicylab": {
        "unknown session": _SESSION_IS_CONNECTION,
        "expired deadline": _NO_DEADLINE,
    },
    "gr00t": {
        "unknown session": _SESSION_IS_CONNECTION,
        "expired deadline": _NO_DEADLINE,
    },
    "vlagents": {
        "unknown session": _SESSION_IS_CONNECTION,
        "wrong key": _NO_KEY,
        "expired deadline": _NO_DEADLINE,
    },
    "lerobot": {
        "metadata": "the protocol has none",
        "wrong key": _NO_KEY,
        "expired deadline": "only gRPC's library knows the deadline of a call",
    },
    "lerobot_remote": {
        "wrong key": _NO_KEY,
        "expired deadline": "only the client knows its deadline",
        "half a message, then close": "Zenoh's library reads the bytes, and passes on only "
        "complete messages",
    },
}


# Dialects over WebSockets


def _websocket(
    name: str,
    path: str,
    settings: dict[str, Any],
    *,
    metadata: Sequence[bytes] = (),
    reset: list[Steps] | None,
    reset_requests: int = 1,
    acts: Sequence[bytes],
    several: Sequence[bytes] = (),
    several_requests: int = 2,
    wrong: bytes,
    greets: bool = False,
    dialect: str = "",
) -> Endpoint:
    """Describe a dialect.

    Args:
        metadata: The messages that request the metadata, if the server does not send them unasked.
        reset: The steps of a client that is connected; None if the protocol has no reset.
        reset_requests: The number of requests that the reset counts as.
        acts: Two messages with an observation.
        several: The messages of a client with two observations, if a message can contain both.
        several_requests: The number of requests that these messages count as.
        wrong: A message whose picture has a wrong shape.
        greets: Whether the server sends the first message, and ends the connection after an error.
        dialect: The dialect of the endpoint, if its name differs from the endpoint's.
    """

    def says(*messages: bytes, who: str = "a") -> list[Steps]:
        return asks(*((websocket_frame(message),) for message in messages), who=who)

    def connect(who: str = "a", key: str | None = None) -> list[Steps]:
        opening: list[Steps] = [Send(who, (handshake(path, key),)), gets(who)]
        return [*opening, gets(who)] if greets else opening

    def is_refused(who: str, key: str | None) -> list[Steps]:
        return [Send(who, (handshake(path, key),)), gets(who), finishes(who)]

    frame = websocket_frame(acts[0])
    half = (frame[: len(frame) // 2],)
    after_error: list[Steps] = [gets(), finishes()] if greets else [says(acts[0]), finishes()]
    situations: dict[str, list[Steps]] = {
        "metadata": [connect(), says(*metadata), finishes()],
        "act": [connect(), says(*acts), finishes()],
        "act with a wrong shape": [connect(), says(wrong), after_error],
        "wrong key": [
            [is_refused("a", WRONG_KEY), is_refused("b", None)],
            [connect("c", KEY), says(acts[0], who="c"), finishes("c")],
        ],
        "garbage": [
            [connect(), says(RUBBISH), after_error],
            [connect("b"), asks((NO_FRAME,), who="b"), finishes("b")],
            [asks((NO_HTTP,), who="c"), finishes("c")],
        ],
        "half a message, then close": [
            [connect(), says(acts[0]), Send("a", half), finishes()],
            [connect("b"), says(acts[0], who="b"), finishes("b")],
        ],
        "stop of the server": [connect(), says(acts[0]), server("stops"), gets(), finishes()],
    }

    if reset is not None:
        situations["reset"] = [connect(), reset, finishes()]

    def costs_with(requests: int, *steps: Steps) -> Cost:
        return Cost(requests, [connect("a", KEY), *steps])

    several_cost: Cost | str = "a message has one observation"
    if several:
        several_cost = costs_with(several_requests, says(*several))
    reset_cost: Cost | str = NOT_APPLICABLE[name].get("reset", "")
    if reset is not None:
        reset_cost = costs_with(reset_requests, reset)
    costs: dict[str, Cost | str] = {
        "reset": reset_cost,
        "act": costs_with(2, says(*acts)),  # The server adds a reset to the first act.
        "close": _SESSION_IS_CONNECTION,
        "several requests": several_cost,
        "malformed message": costs_with(1, says(RUBBISH)),
        "control frame": costs_with(0, asks((PING,))),
    }
    dialects = {"dialects": {dialect or name: settings}}
    return Endpoint(name, path + EACH_BYTE, situations, NOT_APPLICABLE[name], dialects, costs)


def _openpi() -> Endpoint:
    settings = {
        "mapping": "openpi-libero",
        "metadata": {"reset_pose": [0.5]},
        "answer_reset": True,
    }
    reset = asks((websocket_frame(openpi.encode({"reset": True})),))
    return _websocket(
        "openpi",
        "/openpi",
        settings,
        reset=reset,
        acts=[openpi.encode(LIBERO), openpi.encode(LIBERO | {"prompt": "place it"})],
        several=[openpi.encode({"batch": [LIBERO, LIBERO]})],
        wrong=openpi.encode(LIBERO | {"observation/image": PIXELS[0]}),
        greets=True,
    )


def _roboarena() -> Endpoint:
    def infer(**more: Any) -> bytes:
        return openpi.encode(LIBERO | {"endpoint": "infer", "session_id": "one"} | more)

    return _websocket(
        "roboarena",
        "/roboarena",
        {"mapping": "openpi-libero", "action_space": "joint_position"},
        reset=asks((websocket_frame(openpi.encode({"endpoint": "reset"})),)),
        acts=[infer(), infer(session_id="two")],
        wrong=infer(**{"observation/image": PIXELS[0]}),
        greets=True,
    )


def _vla_eval() -> Endpoint:
    def message(kind: Any, seq: int, **payload: Any) -> bytes:
        # The message without the time at which it is sent.
        return masked(vla_eval.encode(vla_eval.VlaEvalMessage(kind, payload, seq)))

    def observation(seq: int, picture: Any = PIXELS) -> bytes:
        return message(
            "observation",
            seq,
            images={"front": picture},
            task_description="pick",
            state=JOINTS,
        )

    # The beginning of an episode is not answered; the action after it belongs to the new episode.
    begin = Send("a", (websocket_frame(message("episode_start", 2)),))
    reset = [begin, asks((websocket_frame(observation(3)),))]
    return _websocket(
        "vla_eval",
        "/vla-eval",
        {"observation_params": {"send_state": True}},
        metadata=[message("hello", 0, protocol_version=1), message("hello", 1, protocol_version=9)],
        reset=reset,
        reset_requests=2,
        acts=[observation(3), observation(4)],
        wrong=observation(3, PIXELS[0]),
    )


def _xpolicylab() -> Endpoint:
    def message(kind: str, message_id: str, **payload: Any) -> bytes:
        labels = {"evaluation_id": "e"}
        # The message without the time at which it is sent.
        return masked(xpolicylab.encode(xpolicylab.Frame(kind, message_id, labels, payload)))

    def observation(picture: Any = PIXELS, **more: Any) -> dict[str, Any]:
        state = {"left_arm_joint_state": JOINTS}
        vision = {"cam_head": {"color": picture}}
        return {"vision": vision, "state": state, "instruction": "pick", **more}

    def infer(message_id: str, picture: Any = PIXELS) -> bytes:
        return message("infer", message_id, observation=observation(picture))

    def call(message_id: str, method: str, obs: Any) -> bytes:
        return message("call", message_id, func_name=method, obs=obs)

    both = [observation(env_idx=0), observation(env_idx=1)]
    return _websocket(
        "xpolicylab",
        "/xpolicylab",
        {"mapping": {"preset": "xpolicylab", "action": {"arm": {}}}},
        metadata=[
            message("hello", "m-1", evaluation_plan={}),
            message("heartbeat", "m-3"),
            message("jump", "m-4"),
            call("m-5", "step", None),
        ],
        reset=asks((websocket_frame(message("reset", "m-1", trial_id="t")),)),
        acts=[infer("m-1"), infer("m-2")],
        several=[
            call("m-1", "update_obs_batch", both),
            call("m-2", "get_action_batch", [0, 1]),
        ],
        several_requests=3,
        wrong=infer("m-1", PIXELS[0]),
    )


# Dialects over HTTP


def _openvla() -> Endpoint:
    seen = {"image": PIXELS, "instruction": "pick"}

    def post(
        body: dict[str, Any] | bytes = seen, session: str = "", **headers: str
    ) -> tuple[bytes]:
        data = body if isinstance(body, bytes) else openvla.encode(body)
        return (http("POST", "/act", data, "application/json", session, **headers),)

    def with_key(who: str, key: str) -> list[Steps]:
        return [asks(post(authorization=f"Bearer {key}"), who=who), finishes(who)]

    half = (post()[0][:-100],)
    situations: dict[str, list[Steps]] = {
        "act": [asks(post(), post(session="s-1"), post(session="s-1")), finishes()],
        "act with a wrong shape": [
            asks(post(seen | {"image": PIXELS[0]}), post(without(seen, "image")), post()),
            finishes(),
        ],
        "wrong key": [
            [with_key("a", WRONG_KEY), asks(post(), who="b"), finishes("b")],
            with_key("c", KEY),
        ],
        "garbage": [
            [asks(post(b"garbage"), post()), finishes()],
            [asks((NO_HTTP,), who="b"), finishes("b")],
        ],
        "half a message, then close": [
            [Send("a", half), finishes()],
            [asks(post(), who="b"), finishes("b")],
        ],
        "stop of the server": [asks(post()), server("stops"), asks(post()), finishes()],
    }

    def costs_with(requests: int, *posts: tuple[bytes]) -> Cost:
        return Cost(requests, asks(*posts))

    key = {"authorization": f"Bearer {KEY}"}
    costs: dict[str, Cost | str] = {
        "reset": NOT_APPLICABLE["openvla"]["reset"],
        "act": costs_with(3, post(**key), post(session="s-1", **key), post(session="s-1", **key)),
        "close": "the protocol has none: a session ends when it is idle",
        "several requests": "a message has one observation",
        "malformed message": costs_with(1, post(b"garbage", **key)),
        "control frame": "HTTP/1.1 has none",
    }
    dialects = {"dialects": {"openvla": {}}}
    return Endpoint("openvla", "http", situations, NOT_APPLICABLE["openvla"], dialects, costs)


def _asking_sglang(prompt: Any = "pick", picture: Any = PIXELS, **more: Any) -> bytes:
    seen = {"images": {"front": picture}, "state": JOINTS}
    return openpi.encode({"input": {"prompt": prompt, "observation": seen}, **more})


def _two_of_sglang() -> bytes:
    seen = {"images": {"front": np.stack([PIXELS] * 2)}, "state": np.stack([JOINTS] * 2)}
    named = {"session_ids": ["slot-0", "slot-1"], "reset_mask": [True, False]}
    return openpi.encode(
        {"input": {"prompt": ["pick"] * 2, "observation": seen}, "parameters": named}
    )


def _sglang() -> Endpoint:
    def post(body: bytes, **headers: str) -> tuple[bytes]:
        kind = "application/msgpack"
        return (http("POST", "/v1/actions/generations", body, kind, "", **headers),)

    metadata = (http("GET", "/v1/actions/metadata", b"", "", ""),)
    act, two = _asking_sglang(), _two_of_sglang()
    raw = _asking_sglang(runtime={"response_format": "raw"})

    def with_key(who: str, key: str) -> list[Steps]:
        return [asks(post(act, authorization=f"Bearer {key}"), who=who), finishes(who)]

    half = (post(act)[0][:-100],)
    situations: dict[str, list[Steps]] = {
        "metadata": [asks(metadata), finishes()],
        "act": [asks(post(act), post(raw), post(two), post(two)), finishes()],
        "act with a wrong shape": [
            asks(
                post(_asking_sglang(picture=PIXELS[0])), post(_asking_sglang(["pick"])), post(act)
            ),
            finishes(),
        ],
        "wrong key": [
            [with_key("a", WRONG_KEY), asks(post(act), who="b"), finishes("b")],
            with_key("c", KEY),
        ],
        "garbage": [
            [asks(post(RUBBISH), post(act)), finishes()],
            [asks((NO_HTTP,), who="b"), finishes("b")],
        ],
        "half a message, then close": [
            [Send("a", half), finishes()],
            [asks(post(act), who="b"), finishes("b")],
        ],
        "stop of the server": [asks(post(act)), server("stops"), asks(post(act)), finishes()],
    }

    def costs_with(requests: int, *posts: tuple[bytes]) -> Cost:
        return Cost(requests, asks(*posts))

    key = {"authorization": f"Bearer {KEY}"}
    costs: dict[str, Cost | str] = {
        "reset": NOT_APPLICABLE["sglang"]["reset"],
        "act": costs_with(2, post(act, **key), post(raw, **key)),
        "close": "the protocol has none: a session ends when it is idle",
        "several requests": costs_with(2, post(two, **key)),
        "malformed message": costs_with(1, post(RUBBISH, **key)),
        "control frame": "HTTP/1.1 has none",
    }
    dialects = {"dialects": {"sglang": {}}}
    return Endpoint("sglang", "http", situations, NOT_APPLICABLE["sglang"], dialects, costs)


def _sglang_realtime() -> Endpoint:
    return _websocket(
        "sglang_realtime",
        "/v1/actions/realtime",
        {},
        reset=None,
        acts=[_asking_sglang(), _asking_sglang("place it")],
        several=[_two_of_sglang()],
        wrong=_asking_sglang(picture=PIXELS[0]),
        greets=True,
        dialect="sglang",
    )


# Dialects with their own port

_GREETING = b"\xff" + bytes(8) + b"\x7f" + b"\x03\0" + b"NULL".ljust(20, b"\0") + bytes(32)
_READY = (
    b"\x04\x26\x05READY"
    b"\x0bSocket-Type\0\0\0\x03REQ"
    b"\x08Identity\0\0\0\0"
)  # fmt: skip
# The command PING, which is answered: the time to live is 0, and the context is "hi".
_PING = b"\x04\x09\x04PING\0\0hi"


def _zmtp_message(payload: bytes) -> bytes:
    """Return a message of a REQ socket: an empty frame, and the frame of the payload."""
    if len(payload) < 256:
        return b"\x01\0" + bytes([0, len(payload)]) + payload
    return b"\x01\0" + b"\x02" + len(payload).to_bytes(8, "big") + payload


def _gr00t() -> Endpoint:
    def observed(picture: Any = PIXELS, robots: int = 1) -> dict[str, Any]:
        robot = {"video": {"ego": picture}, "state": {"arm": JOINTS}, "language": {"task": "pick"}}
        return gr00t.batch([robot] * robots, "task")

    def get_action(picture: Any = PIXELS, key: str | None = None) -> bytes:
        data = {"observation": observed(picture), "options": None}
        return gr00t.write("get_action", data, key)

    def says(*payloads: bytes, who: str = "a") -> list[Steps]:
        return asks(*((_zmtp_message(payload),) for payload in payloads), who=who)

    def connect(who: str = "a") -> list[Steps]:
        return asks((_GREETING,), (_READY,), who=who)

    ping, modalities = (
        gr00t.write("ping", None, None),
        gr00t.write("get_modality_config", None, None),
    )
    reset = gr00t.write("reset", {"options": None}, None)
    wrong = gr00t.write(
        "get_action", {"observation": observed() | {"video": {}}, "options": None}, None
    )
    message = _zmtp_message(get_action())
    half = (message[: len(message) // 2],)
    situations: dict[str, list[Steps]] = {
        "metadata": [connect(), says(ping, modalities), finishes()],
        "reset": [connect(), says(reset), finishes()],
        "act": [connect(), says(get_action(), get_action()), finishes()],
        "act with a wrong shape": [
            connect(),
            says(get_action(PIXELS[0]), wrong, get_action()),
            finishes(),
        ],
        "wrong key": [
            [connect(), says(get_action(key=WRONG_KEY)), finishes()],
            [connect("b"), says(get_action(), who="b"), finishes("b")],
            [connect("c"), says(get_action(key=KEY), who="c"), finishes("c")],
        ],
        "garbage": [
            [connect(), says(RUBBISH, gr00t.write("jump", None, None), get_action()), finishes()],
            asks((NO_HTTP,), who="stranger"),
        ],
        "half a message, then close": [
            [connect(), says(get_action()), Send("a", half), finishes()],
            [connect("b"), says(get_action(), who="b"), finishes("b")],
        ],
        "stop of the server": [connect(), says(get_action()), server("stops"), finishes()],
    }

    def costs_with(requests: int, *payloads: bytes) -> Cost:
        return Cost(requests, [connect(), says(*payloads)])

    both = {"observation": observed(robots=2), "options": None}
    two_robots = gr00t.write("get_action", both, KEY)
    ping_with_key = gr00t.write("ping", None, KEY)
    costs: dict[str, Cost | str] = {
        "reset": costs_with(1, gr00t.write("reset", {"options": None}, KEY)),
        "act": costs_with(2, get_action(key=KEY), get_action(key=KEY)),
        "close": _SESSION_IS_CONNECTION,
        "several requests": costs_with(2, two_robots),
        "malformed message": costs_with(1, gr00t.write("jump", None, KEY)),
        "control frame": Cost(1, [connect(), says(ping_with_key), asks((_PING,))]),
    }
    dialects = {"dialects": {"gr00t": {}}}
    line = "gr00t" + EACH_BYTE
    return Endpoint("gr00t", line, situations, NOT_APPLICABLE["gr00t"], dialects, costs)


def _vlagents() -> Endpoint:
    def call(method: str, *args: str) -> tuple[bytes]:
        return (vlagents.call(7, ("vlagents_ray.Policy", 1, 1), method, *args),)

    def see(**changes: Any) -> tuple[bytes]:
        arm = {"cameras": {"front": PIXELS}, "joints": JOINTS, "gripper": JOINTS[:1] + 0.25}
        observation = {"arm": arm | changes, "language_instruction": "pick"}
        return call("act", vlagents.write_observation(observation))

    old_reset = (
        '[{"cameras": {}, "camera_data_type": "raw", "gripper": 0.5, "info": {}}, "go", '
        '{"seed": 3}]'
    )
    root = (vlagents.get_root(1),)
    half = (see()[0][:100],)
    situations: dict[str, list[Steps]] = {
        "metadata": [asks(root, call("name"), call("is_initialized")), finishes()],
        "reset": [asks(call("reset", old_reset)), finishes()],
        "act": [asks(see(), see()), finishes()],
        "act with a wrong shape": [asks(see(cameras={"front": PIXELS[0]}), see()), finishes()],
        "garbage": [
            [asks(call("act", "{"), call("act"), call("jump"), see())],
            [Send("a", (b"\0\0\0\x03\0bad\n",)), finishes()],
        ],
        "half a message, then close": [
            [asks(see()), Send("a", half), finishes()],
            [asks(see(), who="b"), finishes("b")],
        ],
        "stop of the server": [asks(see()), server("stops"), finishes()],
    }
    dialects = {"dialects": {"vlagents": {}}}
    return Endpoint("vlagents", "vlagents", situations, NOT_APPLICABLE["vlagents"], dialects)


def _lerobot() -> Endpoint:
    def call(method: str, *messages: bytes) -> tuple[bytes, ...]:
        return (f"/transport.AsyncInference/{method}".encode(), *messages)

    def send(observation: Any) -> tuple[bytes, ...]:
        return call("SendObservations", *parts_of(pickled(observation)))

    ready, get_actions = call("Ready", b""), call("GetActions", b"")
    instruct = call("SendPolicyInstructions", field_of(1, pickled(setup())))
    unreadable = call("SendObservations", *parts_of(RUBBISH))
    begin = asks(ready, instruct)
    half = (PREFACE[: len(PREFACE) // 2],)
    situations: dict[str, list[Steps]] = {
        "reset": [begin],
        "act": [begin, asks(send(robot_saw(0)), get_actions, send(robot_saw(1)), get_actions)],
        "act with a wrong shape": [
            [begin, asks(send(robot_saw(0, front=PIXELS[0])))],
            asks(send(robot_saw(0)), get_actions),
        ],
        "unknown session": [asks(get_actions, ready, send(robot_saw(0)))],
        "garbage": [begin, asks(unreadable), asks((NO_HTTP,), who="stranger")],
        "half a message, then close": [Send("stranger", half), finishes("stranger")],
        "stop of the server": [
            [begin, Send("a", get_actions), server("has a request")],
            [server("stops"), gets()],
        ],
    }
    dialects = {"dialects": {"lerobot": {}}}
    return Endpoint("lerobot", "lerobot", situations, NOT_APPLICABLE["lerobot"], dialects)


REMOTE_SETTINGS: dict[str, Any] = {
    "deployment": "so101",
    "semantics": "SO-101, degrees",
    "features": [
        {
            "name": "observation.images.front",
            "shape": [8, 8, 3],
            "dtype": "uint8",
            "kind": "rgb",
            "semantics": "RGB, front",
        },
        {
            "name": "observation.state",
            "shape": [2],
            "names": ["pan", "lift"],
            "semantics": "degrees",
        },
    ],
    "action": {"name": "action", "shape": [7], "semantics": "degrees"},
    "fps": 10,
    "steps": 2,
}


def _lerobot_remote() -> Endpoint:
    sent = remote_messages()

    def says(*names: str) -> list[Steps]:
        """Return the steps that send these messages, each at its Zenoh key, and expect the
        answers.
        """
        ends = {"describe": b"describe", "open": b"open", "observation": b"obs"}
        return asks(*((ends.get(name.split()[0], b"control"), sent[name]) for name in names))

    elsewhere = sent["open append"].replace(b"1" * 32, b"3" * 32)
    situations: dict[str, list[Steps]] = {
        "metadata": [says("describe")],
        "reset": [says("open aligned", "reset aligned", "reset")],
        "act": [says("observation aligned", "observation of another task")],
        "act with a wrong shape": [says("observation with a wrong shape")],
        "unknown session": [asks((b"open", elsewhere))],
        "garbage": [asks((b"describe", RUBBISH), (b"obs", RUBBISH))],
        "stop of the server": [says("observation aligned"), server("stops"), finishes()],
    }
    dialects = {"dialects": {"lerobot_remote": REMOTE_SETTINGS}}
    not_applicable = NOT_APPLICABLE["lerobot_remote"]
    return Endpoint("lerobot_remote", "lerobot_remote", situations, not_applicable, dialects)


DIALECTS = (
    _openpi(),
    _roboarena(),
    _openvla(),
    _sglang(),
    _sglang_realtime(),
    _vla_eval(),
    _xpolicylab(),
    _gr00t(),
    _vlagents(),
    _lerobot(),
    _lerobot_remote(),
)
