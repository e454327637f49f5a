"""Tests of each preset with an observation as the client's own code builds it: all of it arrives,
or the client gets an error.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.errors import InvalidObservation
from vlagents_ray.interface import Obs
from vlagents_ray.serve.config.dialects import presets
from vlagents_ray.wire.mapping import KeyMapping, lookup, matches
from vlagents_ray_dialects.gr00t import nested_mapping
from vlagents_ray_dialects.messages import gr00t as gr00t_codec

TASK = "put the bowl on the stove"
_RANDOM = np.random.default_rng(15)


@dataclass(frozen=True)
class Sent:
    """One observation of a client."""

    preset: str
    source: str
    observation: dict[str, Any]
    cameras: tuple[str, ...]  # the cameras that arrive
    state: dict[str, int]  # the states that arrive, with their sizes
    gripper: bool = False  # whether the gripper arrives


def image(size: int = 32) -> np.ndarray:
    return _RANDOM.integers(0, 256, (size, size, 3), np.uint8)


def chw(size: int = 32) -> np.ndarray:
    return np.ascontiguousarray(image(size).transpose(2, 0, 1))


LIBERO_STATE = np.array([-0.05, 0.03, 0.91, 3.1, 0.02, -0.1, 0.0388, -0.0388])
_LIBERO = {"xyz_axis_angle": 6, "gripper_qpos": 2}
_ALOHA = {"left/joints": 6, "left/gripper": 1, "right/joints": 6, "right/gripper": 1}
_THREE_CAMERAS = ("front", "left_wrist", "right_wrist")
_TWO_ARMS = {
    "left_arm_joint_state": np.ones(6, np.float32),
    "left_ee_joint_state": np.ones(1, np.float32),
    "left_ee_pose": np.ones(7, np.float32),
    "right_arm_joint_state": np.ones(6, np.float32),
    "right_ee_joint_state": np.ones(1, np.float32),
    "right_ee_pose": np.ones(7, np.float32),
}
_OFT = {
    "full_image": image(),
    "state": LIBERO_STATE,
    "instruction": TASK,
    "unnorm_key": "libero_spatial",
}

SENT = [
    Sent(
        "openpi-libero",
        "openpi, examples/libero/main.py",
        {
            "observation/image": image(),
            "observation/wrist_image": image(),
            "observation/state": LIBERO_STATE,
            "prompt": TASK,
        },
        ("front", "wrist"),
        _LIBERO,
        gripper=True,
    ),
    Sent(
        "openpi-droid",
        "openpi, examples/droid/main.py",
        {
            "observation/exterior_image_1_left": image(),
            "observation/wrist_image_left": image(),
            "observation/joint_position": np.arange(7.0) / 10,
            "observation/gripper_position": np.array([0.4]),
            "prompt": TASK,
        },
        ("front", "wrist"),
        {"joints": 7},
        gripper=True,
    ),
    Sent(
        "openpi-aloha",
        "openpi, examples/aloha_sim/env.py",
        {"state": np.arange(14.0), "images": {"cam_high": chw()}, "prompt": TASK},
        ("front",),
        _ALOHA,
    ),
    Sent(
        "openpi-aloha",
        "openpi, examples/simple_client/main.py",
        {
            "state": np.ones((14,)),
            "images": {
                "cam_high": chw(),
                "cam_low": chw(),
                "cam_left_wrist": chw(),
                "cam_right_wrist": chw(),
            },
            "prompt": TASK,
        },
        ("front", "left_wrist", "right_wrist"),
        _ALOHA,
    ),
    Sent(
        "roboarena",
        "roboarena, policy_server's client",
        {
            "observation/exterior_image_0_left": image(),
            "observation/exterior_image_1_left": image(),
            "observation/wrist_image_left": image(),
            "observation/joint_position": np.arange(7, dtype=np.float32) / 10,
            "observation/cartesian_position": np.zeros(6, np.float32),
            "observation/gripper_position": np.zeros(1, np.float32),
            "prompt": TASK,
            "session_id": "episode-1",
            "endpoint": "infer",
        },
        ("front", "front_2", "wrist"),
        {"joints": 7},
        gripper=True,
    ),
    Sent(
        "openvla",
        "openvla, vla-scripts/deploy.py",
        {"image": image(), "instruction": TASK, "unnorm_key": "bridge_orig"},
        ("front",),
        {},
    ),
    Sent(
        "openvla-oft",
        "openvla-oft, experiments/robot/libero/run_libero_eval.py",
        _OFT | {"wrist_image": image()},
        ("front", "wrist"),
        _LIBERO,
        gripper=True,
    ),
    Sent(
        "openvla-oft-aloha",
        "openvla-oft, experiments/robot/aloha/run_aloha_eval.py",
        _OFT
        | {"left_wrist_image": image(), "right_wrist_image": image(), "state": np.arange(14.0)},
        ("front", "left_wrist", "right_wrist"),
        _ALOHA,
    ),
    Sent(
        "gr00t",
        "Isaac-GR00T N1.6, its SO-100 adapter",
        {
            "video": {"front": image()[None, None], "wrist": image()[None, None]},
            "state": {
                "single_arm": np.zeros((1, 1, 5), np.float32),
                "gripper": np.zeros((1, 1, 1), np.float32),
            },
            "language": {"annotation.human.task_description": [[TASK]]},
        },
        ("front", "wrist"),
        {"single_arm": 5, "gripper": 1},
    ),
    Sent(
        "gr00t-n1.5",
        "Isaac-GR00T N1.5, examples/SO-100/eval_lerobot.py",
        {
            "video.front": image()[None],
            "video.wrist": image()[None],
            "state.single_arm": np.zeros((1, 5)),
            "state.gripper": np.zeros((1, 1)),
            "annotation.human.task_description": [TASK],
        },
        ("front", "wrist"),
        {"single_arm": 5, "gripper": 1},
    ),
    Sent(
        "sglang",
        "SGLang 0.5.23, the names of its pi0.5, as `/v1/actions/generations` reads them",
        {
            "images": {"base_0_rgb": image(), "left_wrist_0_rgb": image()},
            "state": np.zeros(8, np.float32),
            "prompt": TASK,
        },
        ("base_0_rgb", "left_wrist_0_rgb"),
        {"state": 8},
    ),
    Sent(
        "rlinf-libero",
        "RLinf, commit a3816b59, rlinf/envs/libero/libero_env.py, one of its environments",
        {
            "main_images": image(),
            "wrist_images": image(),
            "states": LIBERO_STATE,
            "prompt": TASK,
        },
        ("front", "wrist"),
        _LIBERO,
        gripper=True,
    ),
    Sent(
        "vla-eval",
        "vla-eval 0.8.0, benchmarks/libero: send_state, send_wrist_image",
        {
            "images": {"agentview": image(), "wrist": image()},
            "task_description": TASK,
            "states": LIBERO_STATE,
            "controller_states": LIBERO_STATE.astype(np.float32) + 1,
        },
        ("agentview", "wrist"),
        {"state": 8},
    ),
    Sent(
        "vla-eval",
        "vla-eval 0.8.0, its smoke test",
        {
            "images": {"agentview": image(), "wrist": image()},
            "task_description": "smoke test",
            "state": np.zeros(8, np.float32),
        },
        ("agentview", "wrist"),
        {"state": 8},
    ),
    Sent(
        "vla-eval",
        "vla-eval 0.8.0, benchmarks/libero as it is: no state",
        {"images": {"agentview": image()}, "task_description": TASK},
        ("agentview",),
        {},
    ),
    Sent(
        "robodojo",
        "vla-eval 0.8.0, benchmarks/robodojo",
        {
            "images": {
                "cam_head": image(),
                "cam_left_wrist": image(),
                "cam_right_wrist": image(),
            },
            "task_description": TASK,
            "state": np.arange(14, dtype=np.float32),
        },
        _THREE_CAMERAS,
        _ALOHA,
    ),
    Sent(
        "robotwin",
        "vla-eval 0.8.0, benchmarks/robotwin",
        {
            "images": {
                "head_camera": image(),
                "left_camera": image(),
                "right_camera": image(),
            },
            "task_description": TASK,
            "joint_state": np.arange(14.0),
        },
        _THREE_CAMERAS,
        _ALOHA,
    ),
    Sent(
        "xpolicylab",
        "XPolicyLab, commit 7198143e, debug_env_client.py with two arms",
        {
            "vision": {
                name: {
                    "color": image(),
                    "depth": np.zeros((32, 32, 3), np.uint8),
                    "intrinsic_matrix": np.eye(3).tolist(),
                    "shape": [32, 32],
                }
                for name in ("cam_head", "cam_left_wrist", "cam_right_wrist")
            },
            "instruction": TASK,
            "state": _TWO_ARMS | {"mobile": {"base_pose": [0.0] * 7, "base_twist": [0.0] * 6}},
            "additional_info": {"frequency": 30},
            "data_format_version": "v1.0",
            "env_idx": 0,
        },
        _THREE_CAMERAS,
        _ALOHA | {"left/ee_pose": 7, "right/ee_pose": 7},
    ),
    Sent(
        "xpolicylab-ee",
        "XPolicyLab, commit 7198143e, debug_env_client.py with one arm",
        {
            "vision": {"cam_head": {"color": image()}, "cam_wrist": {"color": image()}},
            "instruction": TASK,
            "state": {
                "arm_joint_state": np.zeros(6, np.float32),
                "ee_joint_state": np.zeros(1, np.float32),
                "ee_pose": np.ones(7, np.float32),
                "tcp_pose": np.zeros(7, np.float32),
            },
        },
        ("front", "wrist"),
        {"joints": 6, "gripper": 1, "ee_pose": 7},
    ),
    Sent(
        "vlagents",
        "vlagents 0.3.0, as its gateway hands it to a mapping",
        {
            "cameras": {"rgb_side": image()},
            "state": {"joints": np.zeros(7), "xyzrpy": np.zeros(6)},
            "info": {},
            "gripper": 1.0,
        },
        ("rgb_side",),
        {"joints": 7, "xyzrpy": 6},
        gripper=True,
    ),
    Sent(
        "lerobot",
        "LeRobot 0.4.4, async_inference/robot_client.py with an SO-100, by the names of its "
        "features",
        {
            "observation.state": np.zeros(6, np.float32),
            "observation.images.front": image(),
            "observation.images.wrist": image(),
            "task": TASK,
        },
        ("front", "wrist"),
        {"joints": 6},
    ),
]

each = pytest.mark.parametrize("sent", SENT, ids=lambda sent: f"{sent.preset}: {sent.source}")


def arrive(sent: Sent, change: Callable[[str], str] = str) -> tuple[Obs, str | None]:
    """Return the observation and instruction that the mapping reads, for GR00T after the gateway's
    conversion; `change` renames the client's keys.
    """
    mapping = presets()[sent.preset]
    if not sent.preset.startswith("gr00t"):
        return mapping.obs(renamed(sent.observation, change))
    [one] = gr00t_codec.read_observations(sent.observation).each
    return nested_mapping(mapping)[0].obs(renamed(gr00t_codec.at_its_time_step(one), change))


def renamed(nested: dict[str, Any], change: Callable[[str], str]) -> dict[str, Any]:
    return {
        change(key): renamed(one, change) if isinstance(one, dict) else one
        for key, one in nested.items()
    }


def test_every_preset_is_tried_with_its_clients_observation() -> None:
    assert {sent.preset for sent in SENT} == set(presets())


@each
def test_cameras_state_gripper_and_instruction_arrive(sent: Sent) -> None:
    obs, instruction = arrive(sent)
    assert tuple(obs.cameras) == sent.cameras
    assert all(camera.shape == (32, 32, 3) and camera.max() > 0 for camera in obs.cameras.values())
    assert {name: part.size for name, part in obs.state.items()} == sent.state
    assert (obs.gripper is not None) == sent.gripper
    # The gateway of vlagents reads the instruction next to the observation, without the mapping.
    if sent.preset != "vlagents":
        assert instruction == ("smoke test" if "smoke" in sent.source else TASK)


@each
def test_an_observation_under_other_names_is_refused_and_never_empty(sent: Sent) -> None:
    """The test renames all keys, only the cameras, or only the state."""
    mapping = presets()[sent.preset]
    states = [one for entries in mapping.state.values() for one in entries]
    for entries in (
        [],
        *([mapping.cameras.values()] if sent.cameras else []),
        *([states] if sent.state else []),
    ):
        known = {part for one in entries for part in one.key.split("|")}
        theirs = known | {part.partition("/")[0].partition(".")[0] for part in known}
        renames = {False: str, True: "their_{}".format}
        with pytest.raises(InvalidObservation, match="their_"):
            arrive(
                sent,
                lambda key: renames[not theirs or any(matches(key, one) for one in theirs)](key),  # noqa: B023
            )


def test_of_two_names_of_one_state_the_first_counts() -> None:
    obs, _ = presets()["vla-eval"].obs({"images": {}, "states": np.ones(3), "state": np.zeros(8)})
    assert obs.state["state"].tolist() == [1, 1, 1]


def test_a_state_is_taken_from_a_key_that_holds_numbers_and_not_a_map_of_them() -> None:
    """vla-eval's RoboCasa365 sends a map, for which a deployment needs another mapping."""
    theirs = {
        "images": {"front": np.zeros((8, 8, 3), np.uint8)},
        "state": {"state.gripper_qpos": np.zeros(2)},
    }
    with pytest.raises(InvalidObservation, match=r"state/state\.gripper_qpos.*mapping\.state"):
        presets()["vla-eval"].obs(theirs)


def test_arrays_that_cannot_be_a_state_and_those_that_are_read_as_info_are_not_missed() -> None:
    """Examples are a camera's matrix, an image that the mapping does not read, and a number."""
    theirs = {
        "image": np.zeros((8, 8, 3), np.uint8),
        "other": np.zeros((8, 8, 3), np.uint8),
        "intrinsics": np.eye(3),
        "time": 1.0,
        "raw": np.zeros(9),
    }
    mapping = KeyMapping.from_json(
        {
            "cameras": {"front": "image"},
            "state": {"joints": {"key": "joints", "optional": True}},
            "info": {"raw": "raw"},
        }
    )
    assert list(mapping.obs(theirs)[0].cameras) == ["front"]
    with pytest.raises(InvalidObservation, match=r"\['raw'\].*mapping\.info"):
        KeyMapping.from_json(mapping.to_json() | {"info": {}}).obs(theirs)


OPENPI = [
    sent
    for sent in SENT
    if sent.preset in ("openpi-libero", "openpi-droid", "openpi-aloha", "roboarena")
]


@pytest.mark.parametrize("sent", OPENPI, ids=lambda sent: sent.preset)
@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.uint8])
@pytest.mark.parametrize("first", [True, False])
def test_openpis_images_come_as_its_own_server_takes_them(
    sent: Sent, dtype: type, first: bool
) -> None:
    """`_parse_image` of openpi's policies multiplies floats in [0, 1] by 255 and rounds down, and
    moves a first axis of three channels to the end.
    """

    def theirs(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: theirs(one) for key, one in value.items()}
        if not isinstance(value, np.ndarray) or value.ndim != 3:
            return value
        value = value if dtype is np.uint8 else value.astype(dtype) / 255
        return value.transpose(2, 0, 1) if first and value.shape[2] == 3 else value

    def parsed(image: np.ndarray) -> np.ndarray:
        if np.issubdtype(image.dtype, np.floating):
            image = (255 * image).astype(np.uint8)
        return np.moveaxis(image, 0, -1) if image.shape[0] == 3 else image

    changed, mapping = theirs(sent.observation), presets()[sent.preset]
    obs, _ = mapping.obs(changed)
    for name, camera in obs.cameras.items():
        np.testing.assert_array_equal(camera, parsed(lookup(changed, mapping.cameras[name].key)))
        assert camera.dtype == np.uint8


@pytest.mark.parametrize("value", [1.5, -0.1, np.nan, 255.0])
def test_floats_that_are_no_picture_are_refused_with_their_range(value: float) -> None:
    image = np.full((8, 8, 3), 0.5)
    image[0, 0, 0] = value
    with pytest.raises(InvalidObservation, match=r"'image'.*\[0, 1\]"):
        presets()["openvla"].obs({"image": image, "instruction": TASK})


@pytest.mark.parametrize("reading", [0.9, -3.0, float("nan")])
def test_what_the_policy_does_not_want_may_have_any_value(reading: float) -> None:
    """openpi's examples/simple_client sends `np.random.rand(8)` as LIBERO's state."""
    [sent] = [one for one in SENT if one.preset == "openpi-libero"]
    state = np.full(8, 0.5)
    state[6] = reading
    theirs = sent.observation | {"observation/state": state}
    mapping = presets()["openpi-libero"]
    for contract in (Contract(action=ActionSpec(7)), None):
        obs, _ = mapping.obs(theirs, contract=contract)
        assert obs.gripper is None
        np.testing.assert_array_equal(obs.state["gripper_qpos"], np.float32([reading, 0.5]))
    with pytest.raises(InvalidObservation, match=r"mapping\.gripper"):
        mapping.obs(theirs, contract=Contract(gripper=True))


def test_an_alpha_channel_is_left_out() -> None:
    mapping = KeyMapping.from_json({"cameras": {"front": {"key": "image", "layout": "rgba"}}})
    pixels = np.arange(8 * 8 * 4, dtype=np.uint8).reshape(8, 8, 4)
    obs, _ = mapping.obs({"image": pixels})
    assert np.array_equal(obs.cameras["front"], pixels[:, :, :3])
    with pytest.raises(InvalidObservation, match="image"):
        mapping.obs({"image": np.zeros((8, 8, 5), np.uint8)})


@pytest.mark.parametrize("number", [np.array([3]), np.array([[3]])])
def test_a_number_in_place_of_an_instruction_has_its_text(number: np.ndarray) -> None:
    fields = {
        "state": {"joints": "state"},
        "instruction": "prompt|task_id",
        "instructions": {"3": "turn on the radio"},
    }
    mapping = KeyMapping.from_json(fields)
    theirs = {"state": np.zeros(7), "task_id": number}
    assert mapping.obs(theirs)[1] == "turn on the radio"
    needed = Contract(instruction=True)
    with pytest.raises(
        InvalidObservation,
        match=r"expected one of \['3'\], got 4; add its text to mapping.instructions",
    ):
        mapping.obs(theirs | {"task_id": number + 1}, contract=needed)
    with pytest.raises(InvalidObservation, match="expected text"):
        mapping.obs(theirs | {"task_id": np.array([0.5])})
    assert mapping.obs(theirs | {"task_id": number + 1})[1] is None, (
        "a policy without an instruction needs no texts"
    )
