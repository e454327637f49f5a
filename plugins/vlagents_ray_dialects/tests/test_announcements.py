"""What a dialect announces to its clients follows from the policy's contract: each field of the
contract, changed, changes the announcement, or the dialect does not start, if the protocol has a
place for the field.
"""

from __future__ import annotations

import json
import socket
from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import pytest
from dialect_server import receive, send, serving
from served_agents import Mirror

from vlagents_ray.contract import ActionSpec, CameraSpec, Contract, StateSpec
from vlagents_ray.errors import ConfigError
from vlagents_ray.protocol.messages import DEFAULT_LIMITS
from vlagents_ray.registry import names
from vlagents_ray.serve.access.api_keys import NoKey
from vlagents_ray.serve.config.dialects import DialectArgs
from vlagents_ray.serve.dialects.base import GatewayContext
from vlagents_ray_dialects.gr00t import GR00TConnection, GR00TDialect, GR00TDialectConfig
from vlagents_ray_dialects.messages import openpi

ACTION = ActionSpec(
    dim=8, space="ee_pose", delta=False, rotation="axis_angle", gripper_open=1.0, gripper_closed=0.0
)
CONTRACT = Contract(
    cameras={"front": CameraSpec(180, 320)},
    state={"joints": StateSpec(7)},
    gripper=False,
    instruction=True,
    action=ACTION,
    control_hz=10.0,
    chunk=8,
)

# Each change of a field, by its name.
CHANGES: dict[str, Contract] = {
    "cameras": replace(CONTRACT, cameras={"front": CameraSpec(180, 320), "side": CameraSpec()}),
    "camera sizes": replace(CONTRACT, cameras={"front": CameraSpec(224, 224)}),
    "state": replace(CONTRACT, state={"pose": StateSpec(7)}),
    "instruction": replace(CONTRACT, instruction=False),
    "control_hz": replace(CONTRACT, control_hz=20.0),
    "chunk": replace(CONTRACT, chunk=4),
    "action.dim": replace(CONTRACT, action=replace(ACTION, dim=7)),
    "action.space": replace(CONTRACT, action=replace(ACTION, space="joint", rotation=None)),
    "action.delta": replace(CONTRACT, action=replace(ACTION, delta=True)),
    "action.rotation": replace(CONTRACT, action=replace(ACTION, rotation="quat_xyzw")),
    "action.gripper": replace(
        CONTRACT, action=replace(ACTION, gripper_open=-1.0, gripper_closed=1.0)
    ),
}

# The fields for which a protocol has a place before a client's first observation.
PLACES: dict[str, set[str]] = {
    "roboarena": {
        "cameras",
        "camera sizes",
        "state",
        "action.dim",
        "action.space",
        "action.delta",
    },
    "vla_eval": {
        "instruction",
        "action.space",
        "action.delta",
        "action.rotation",
        "action.gripper",
    },
    "gr00t": {"cameras", "state", "chunk"},
    "sglang": {"cameras", "chunk", "action.dim"},
    "lerobot_remote": {"cameras", "state", "control_hz", "chunk", "action.dim"},
}
# Protocols whose servers send nothing about the policy before the first observation.
SILENT = {"openpi", "openvla", "xpolicylab", "lerobot", "vlagents"}


def declaring(contract: Contract) -> Mirror:
    class Declared(Mirror):
        pass

    Declared.contract = contract
    return Declared()


def of_roboarena(contract: Contract) -> Any:
    DialectArgs(roboarena={}).require_fit(contract)  # type: ignore[arg-type]
    with (
        serving(declaring(contract), {"roboarena": {}}) as (client, _),
        client.websocket_connect("/roboarena") as websocket,
    ):
        return openpi.decode(websocket.receive_bytes())


def of_vla_eval(contract: Contract) -> Any:
    with (
        serving(declaring(contract), {"vla_eval": {}}) as (client, _),
        client.websocket_connect("/vla-eval") as websocket,
    ):
        send(websocket, "hello", {"protocol_version": 1}, 0)
        return receive(websocket).payload


def of_sglang(contract: Contract) -> Any:
    with serving(declaring(contract), {"sglang": {}}) as (client, _):
        return client.get("/v1/actions/metadata").json()


def of_gr00t(contract: Contract) -> Any:
    dialect = GR00TDialect("gr00t", GR00TDialectConfig(), context_of(contract))
    with socket.socket() as unconnected:
        return GR00TConnection(dialect, unconnected)._modalities()


def of_lerobot_remote(contract: Contract) -> Any:
    pytest.importorskip("zenoh")
    from vlagents_ray_dialects.lerobot_remote import (
        LeRobotRemoteDialect,
        LeRobotRemoteDialectConfig,
    )

    image = {"name": "observation.images.front", "dtype": "uint8", "kind": "rgb"}
    joints = {"name": "observation.state", "shape": [7], "names": list("abcdefg")}
    action = {"name": "action", "shape": [8], "semantics": "rad"}
    config = LeRobotRemoteDialectConfig(
        deployment="arm",
        semantics="one arm",
        features=[
            {**image, "shape": [180, 320, 3], "semantics": "rgb"},
            {**joints, "semantics": "rad"},
        ],
        action=action,
    )
    descriptor = LeRobotRemoteDialect("lerobot_remote", config, context_of(contract)).offer
    told: dict[str, Any] = descriptor.descriptor()
    del told["instance_id"]  # drawn for each server
    return told


def context_of(contract: Contract) -> GatewayContext:
    return GatewayContext("noop", None, DEFAULT_LIMITS, 8, 30.0, contract, NoKey.OPEN)  # type: ignore[arg-type]


ANNOUNCE: dict[str, Callable[[Contract], Any]] = {
    "roboarena": of_roboarena,
    "vla_eval": of_vla_eval,
    "gr00t": of_gr00t,
    "sglang": of_sglang,
    "lerobot_remote": of_lerobot_remote,
}


def announced(dialect: str, contract: Contract) -> str:
    """Return the announcement as a text, or the error with which the dialect does not start."""
    try:
        return json.dumps(ANNOUNCE[dialect](contract), default=repr, sort_keys=True)
    except ConfigError as error:
        return f"does not start: {error}"


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("dialect", ANNOUNCE)
def test_each_field_of_the_contract_changes_the_announcement(dialect: str, change: str) -> None:
    before = announced(dialect, CONTRACT)
    assert not before.startswith("does not start"), before
    has_changed = announced(dialect, CHANGES[change]) != before
    assert has_changed == (change in PLACES[dialect])


def test_each_dialect_and_each_field_is_here() -> None:
    assert set(ANNOUNCE) | SILENT == set(names("dialects"))
    changed = set(CHANGES) - {"camera sizes"}
    # A gripper's value is not announced, and the others say how the policy computes.
    not_announced = {"gripper", "history", "behaviour"}
    expected = {field.name for field in fields(Contract)} - not_announced
    assert {change.partition(".")[0] for change in changed} == expected
