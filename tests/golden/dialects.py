"""Scenarios of other systems' protocols. The requests are encoded by the codecs with which this
package calls such servers.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from golden import png

from tests.golden.masks import masked
from tests.golden.scenarios import Send, asks, gets, http, scenario
from tests.golden.traces import Step, Trace, read
from vlagents_ray_dialects.messages import gr00t, openpi, openvla, rpyc, vla_eval, vlagents

PIXELS = np.full((8, 8, 3), 7, np.uint8)
JOINTS = np.array([0.25, -0.5], np.float32)
LIBERO = {
    "observation/image": PIXELS,
    "observation/wrist_image": PIXELS,
    "observation/state": np.array([0, 0, 0, 0, 0, 1, 0.04, -0.04]),
    "prompt": "pick",
}
RUBBISH = b"\xc1 rubbish"


def without(theirs: dict[str, Any], key: str) -> dict[str, Any]:
    return {name: value for name, value in theirs.items() if name != key}


def maps() -> Iterator[Trace]:
    """Yield scenarios of openpi's protocol and its relatives, whose servers send the first
    message.
    """

    def infer(**more: Any) -> bytes:
        return openpi.encode(LIBERO | {"endpoint": "infer"} | more)

    first, opened, at, mapped = (
        gets(),
        Step("a", "opens"),
        ("/openpi", "/"),
        {"mapping": "openpi-libero"},
    )
    on = {"openpi": mapped | {"metadata": {"reset_pose": [0.5]}, "answer_reset": True}}
    seen, other = openpi.encode(LIBERO), LIBERO | {"prompt": "place it"}
    begin, again = openpi.encode({"reset": True}), openpi.encode({"endpoint": "reset"})
    batches = (openpi.encode({"batch": [LIBERO, other]}), openpi.encode({"batch": [LIBERO]}))
    whole = asks(seen, seen, openpi.encode(other), begin, seen, *batches)
    yield from scenario("openpi: an episode, and a batch", at, opened, first, whole, dialects=on)
    for says, sent in {
        "a missing key": openpi.encode(without(LIBERO, "observation/image")),
        "no prompt": openpi.encode(without(LIBERO, "prompt")),
        "a failing policy": openpi.encode(LIBERO | {"prompt": "fail"}),
        "a wrong shape": openpi.encode(LIBERO | {"observation/image": PIXELS[0]}),
        "a wrong reset": openpi.encode({"reset": 1}),
        "rubbish": RUBBISH,
        "too much": bytes(4097),
    }.items():
        yield from scenario(f"openpi: {says}", at[:1], first, asks(sent), gets(), dialects=on)
    yield from scenario("openpi: not ready", at[:1], opened, dialects=on, ready=False)
    named = asks(
        *(infer(session_id=name) for name in ("one", "one", "two")),
        again,
        infer(),
        infer(endpoint="jump"),
    )
    at, on = ("/roboarena",), {"roboarena": {**mapped, "action_space": "joint_position"}}
    yield from scenario("roboarena: episodes, and an error", at, first, named, gets(), dialects=on)


def documents() -> Iterator[Trace]:
    """Yield scenarios of OpenVLA's protocol over HTTP."""

    def post(body: Any, session: str = "") -> tuple[bytes]:
        data = body if isinstance(body, bytes) else openvla.encode(body)
        return (http("POST", "/act", data, "application/json", session),)

    seen = {"image": PIXELS, "instruction": "pick"}
    twice = {"encoded": openvla.encode(seen).decode()}
    lone = asks(*map(post, [seen, twice, without(seen, "image"), without(seen, "instruction")]))
    kept = asks(
        post(seen, "s-1"), post(seen, "s-1"), post(seen | {"instruction": "place it"}, "s-1")
    )
    wrong = [seen | {"instruction": "fail"}, seen | {"image": PIXELS[0]}, b"{", b"[]", bytes(5000)]
    yield from scenario(
        "openvla: requests",
        ("http",),
        lone,
        kept,
        asks(*map(post, wrong)),
        dialects={"openvla": {}},
    )
    chunk = {"openvla": {"chunk": True}}
    yield from scenario("openvla: a chunk", ("http",), asks(post(seen)), dialects=chunk)
    yield from scenario(
        "openvla: not ready", ("http",), asks(post(seen)), dialects=chunk, ready=False
    )


def benchmarks() -> Iterator[Trace]:
    """Yield scenarios of vla-eval's protocol."""

    def message(kind: Any, seq: int, **payload: Any) -> bytes:
        message = vla_eval.VlaEvalMessage(kind, payload, seq)
        return masked(vla_eval.encode(message))  # masks the time in the message

    def seen(seq: int, task: str = "pick", **images: Any) -> bytes:
        return message(
            "observation",
            seq,
            images=images or {"front": PIXELS},
            task_description=task,
            state=JOINTS,
        )

    file = {"__image__": True, "format": "png", "data": png(PIXELS)}
    no_file = file | {"data": b"GIF89a"}
    yield from scenario(
        "vla_eval: episodes, and errors",
        ("/vla-eval",),
        asks(message("hello", 0, protocol_version=1), message("hello", 1, protocol_version=9)),
        [Send("a", message("episode_start", 2)), asks(seen(3), seen(4), seen(5))],
        [
            Send("a", message("episode_end", 6)),
            asks(seen(7, "place it", front=file), seen(8, "fail")),
        ],
        asks(message("observation", 9, images={}), message("jump", 10), RUBBISH, seen(11)),
        asks(seen(12, front=no_file), bytes(4097)),
        dialects={"vla_eval": {"observation_params": {"send_state": True}}},
    )


def gateways() -> Iterator[Trace]:
    """Yield scenarios of dialects with a separate port, which are clients of the replica."""

    def batch(number: int = 1, text: str = "pick", key: str = "task") -> dict[str, Any]:
        one = {"video": {"ego": PIXELS}, "state": {"arm": JOINTS}, "language": {"task": text}}
        return gr00t.batch([one] * number, key)

    def get(observation: dict[str, Any], **options: Any) -> bytes:
        return gr00t.write(
            "get_action", {"observation": observation, "options": None}, None, **options
        )

    def say(endpoint: str, data: Any = None) -> bytes:
        return gr00t.write(endpoint, data, None)

    flat = gr00t.flat(batch(key="annotation.human.task"))
    yield from scenario(
        "gr00t: requests",
        ("gr00t",),
        asks(
            say("ping"),
            say("get_modality_config"),
            get(batch()),
            get(batch()),
            say("reset", {"options": None}),
        ),
        asks(
            get(batch(), packed=True),
            get(batch(text="place it")),
            get(batch(2)),
            say("get_action", flat),
        ),
        asks(
            say("get_modality_config"),
            get(batch(text="fail")),
            get(batch() | {"video": {}, "state": {}}),
        ),
        asks(say("get_action", 7), say("jump"), RUBBISH, get(batch())),
        dialects={"gr00t": {}},
    )

    # LeRobot's clients send pickles, which this package cannot write. So the requests remain those
    # in the file.
    yield from (one.sent() for one in read("gateways") if one.name.startswith("lerobot"))

    def ask(method: str, *args: str) -> bytes:
        return vlagents.call(7, ("vlagents_ray.Policy", 1, 1), method, *args)

    def see(text: str = "pick", **changes: Any) -> bytes:
        arm = {"cameras": {"front": PIXELS}, "joints": JOINTS, "gripper": np.array([0.5])} | changes
        return ask("act", vlagents.write_observation({"arm": arm, "language_instruction": text}))

    old = (
        '[{"cameras": {}, "camera_data_type": "raw", "gripper": 0.5, "info": {}}, "go", '
        '{"seed": '
        "3}]"
    )
    ping = rpyc.request(8, rpyc.Handler.PING, (rpyc.VALUE, ("hi",)))
    look = rpyc.request(9, rpyc.Handler.INSPECT, (rpyc.VALUE, ()))
    yield from scenario(
        "vlagents: calls",
        ("vlagents",),
        asks(vlagents.get_root(1), ask("name"), ask("is_initialized"), ping, look),
        asks(
            see(),
            see(),
            see("place it"),
            ask("reset", old),
            see("fail"),
            see(cameras={"front": PIXELS[0]}),
        ),
        asks(ask("act", "{"), ask("act"), ask("jump"), see(), b"\0\0\0\x03\0bad\n"),
        dialects={"vlagents": {}},
    )
