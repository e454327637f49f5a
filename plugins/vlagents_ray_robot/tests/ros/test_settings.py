"""Tests of the file of topics: its valid settings, and the errors with a cure for invalid ones."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import Any

import pytest
import yaml
from wrong_yaml import WRONG

import vlagents_ray.cli.robot as robot_command
from vlagents_ray.errors import ConfigError
from vlagents_ray_robot.ros import read_settings
from vlagents_ray_robot.ros.robot import settings_from

EXAMPLES = Path(__file__).parents[4] / "examples/ros"
ARM: dict[str, Any] = {
    "link": "ws://arm-pc:9090",
    "cameras": {"front": {"topic": "/camera/image_raw"}},
    "state": {"joints": {"topic": "/joint_states", "names": ["a", "b"]}},
    "actions": [
        {
            "topic": "/arm/commands",
            "type": "std_msgs/msg/Float64MultiArray",
            "numbers": 2,
            "stop": "joints",
        },
    ],
}


@pytest.mark.parametrize("file", sorted(EXAMPLES.glob("*.yaml")), ids=lambda file: file.stem)
def test_the_examples_are_read(file: Path) -> None:
    assert read_settings(file).dim >= 1


def test_the_files_and_commands_of_the_documentation_are_read() -> None:
    page = (EXAMPLES.parents[1] / "docs/ros.md").read_text()
    files = re.findall(r"```yaml\n(.*?)```", page, re.DOTALL)
    lines = [
        *page.replace("\\\n", " ").splitlines(),
        *(EXAMPLES / "arm.yaml").read_text().splitlines(),
    ]
    commands = [
        line.split("vlagents-ray robot ")[1] for line in lines if "vlagents-ray robot " in line
    ]
    assert [settings_from(yaml.safe_load(file), "docs/ros.md").dim for file in files] == [4]
    assert [robot_command.parse(shlex.split(words)).policy for words in commands] == 2 * [
        "http://gpu-box:8000"
    ]


def test_types_and_limits_have_defaults_and_an_action_the_numbers_of_all_its_topics(
    tmp_path: Path,
) -> None:
    (tmp_path / "arm.yaml").write_text(yaml.safe_dump(ARM))
    settings = read_settings(tmp_path / "arm.yaml")
    front, joints = settings.cameras["front"], settings.state["joints"]
    assert (front.type, joints.type, joints.names) == (
        "sensor_msgs/msg/Image",
        "sensor_msgs/msg/JointState",
        ("a", "b"),
    )
    assert (front.max_age_s, front.silent_s, settings.dim) == (0.3, 1.0, 2)
    actions = [
        {
            "topic": "/t",
            "type": "trajectory_msgs/msg/JointTrajectory",
            "names": ["a", "b"],
            "stop": "joints",
        },
        {
            "topic": "/g",
            "type": "sensor_msgs/msg/JointState",
            "names": ["finger"],
            "stop": "nothing",
        },
        {"topic": "/v", "type": "geometry_msgs/msg/Twist", "fields": ["linear.x", "angular.z"]},
    ]
    assert settings_from({**ARM, "actions": actions}, "f").dim == 5


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"link": "tcp://x"}, "link: expected 'ros2', or a rosbridge.*got 'tcp://x'"),
        ({"lnik": "ros2"}, "did you mean 'link'"),
        (
            {"cameras": {"front": {"topic": "/c", "tpye": "x"}}},
            "cameras.front: .*did you mean 'type'",
        ),
        (
            {"cameras": {"front": {"topic": "/c", "type": "sensor_msgs/msg/PointCloud2"}}},
            "front: type: expected one of .*got",
        ),
        ({"cameras": {"front": "/camera"}}, "cameras.front: expected keys with values, got str"),
        ({"cameras": {"front": {"topic": 3}}}, "topic: expected str, got 3"),
        (
            {"state": {"joints": {"topic": "/j", "names": "a"}}},
            "names: expected a list of names, got 'a'",
        ),
        (
            {"state": {"joints": {"topic": "/j", "names": [1]}}},
            r"names: expected a list of names, got \[1\]",
        ),
        (
            {"state": {"joints": {"topic": "/j", "values": "torque"}}},
            "values: expected one of .*, got 'torque'",
        ),
        (
            {"state": {"joints": {"topic": "/camera/image_raw"}}},
            "as sensor_msgs/msg/Image, as elsewhere in the file",
        ),
        ({"cameras": {}, "state": {}}, "expected a camera, state or gripper"),
        ({"actions": []}, "actions: expected the topics that command the robot, got none"),
        ({"actions": {"topic": "/a"}}, "expected a list of topics"),
        (
            {"actions": [{**ARM["actions"][0], "stop": ""}]},
            "the value that stops /arm/commands, got none; set 'zeros' where",
        ),
        (
            {"actions": [{**ARM["actions"][0], "stop": "joint"}]},
            "stop: expected one of .*'joints'.*got 'joint'",
        ),
        ({"actions": [{**ARM["actions"][0], "numbers": 0}]}, "expected `numbers`.*got none"),
        (
            {"actions": [{**ARM["actions"][0], "type": "std_msgs/msg/String"}]},
            "type: expected one of .*got 'std_msgs/msg/String'",
        ),
        (
            {
                "actions": [
                    {"topic": "/v", "type": "geometry_msgs/msg/Twist", "fields": ["linear.w"]}
                ]
            },
            "fields: expected one of",
        ),
        (
            {"actions": [{**ARM["actions"][0], "grippers": [2]}]},
            r"grippers: expected one of \[0, 1\], got 2",
        ),
        (
            {"actions": [{**ARM["actions"][0], "grippers": "b"}]},
            "grippers: expected a list of numbers.*got 'b'",
        ),
        (
            {"actions": [{**ARM["actions"][0], "grippers": [1], "stop": "zeros"}]},
            "and no `gripper`; add the topic",
        ),
        ({"gripper": {"topic": "/joint_states"}}, "set `open` and `closed`"),
        ({"max_age_s": 0}, "max_age_s: expected a number above 0, got 0"),
        ({"max_age_s": float("nan")}, "max_age_s: expected a number above 0, got nan"),
        (
            {"heartbeat": {"topic": "/h", "hz": -1}},
            "heartbeat: hz: expected a number above 0, got -1",
        ),
        ({"clock": "sim"}, "clock: expected one of .*got 'sim'"),
    ],
)
def test_a_wrong_setting_is_an_error_that_names_it_and_the_cure(
    change: dict[str, Any], said: str
) -> None:
    with pytest.raises(ConfigError, match=said) as error:
        settings_from({**ARM, **change}, "arm.yaml")
    assert str(error.value).startswith("arm.yaml")


@pytest.mark.slow
@pytest.mark.parametrize("mistake", WRONG)
def test_a_file_that_cannot_be_read_is_an_error_that_names_it(mistake: str, tmp_path: Path) -> None:
    text, word = WRONG[mistake]
    (tmp_path / "broken.yaml").write_bytes(text)
    with pytest.raises(ConfigError, match=rf"(?s)broken\.yaml.*{word}"):
        read_settings(tmp_path / "broken.yaml")


def test_a_missing_file_is_an_error_that_names_it(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"missing\.yaml"):
        read_settings(tmp_path / "missing.yaml")


NUMBERS, STATE = "std_msgs/msg/Float64MultiArray", "sensor_msgs/msg/JointState"
FINGERS = {
    "gripper": {"topic": "/joint_states", "names": ["finger"], "open": 0.04, "closed": 0.0},
    "state": {"joints": {"topic": "/joint_states", "names": ["a", "finger"]}},
}
NAMED = {"topic": "/arm", "type": STATE, "names": ["a", "Robotiq_Gripper"]}
ONE = {"topic": "/arm/gripper/commands", "type": NUMBERS, "numbers": 1}


@pytest.mark.parametrize(
    ("change", "actions", "grippers"),
    [
        ({}, [{"topic": "/arm", "type": NUMBERS, "numbers": 2, "stop": "joints"}], []),
        (FINGERS, [{"topic": "/arm", "type": NUMBERS, "numbers": 2, "stop": "joints"}], [1]),
        (
            FINGERS,
            [{"topic": "/t", "type": STATE, "names": ["finger", "a"], "stop": "joints"}],
            [0],
        ),
        ({}, [{**NAMED, "stop": "joints"}], [1]),
        ({}, [{**NAMED, "stop": "zeros"}], []),  # velocities
        ({}, [{**NAMED, "stop": "joints", "grippers": [0]}], [0]),
        ({}, [{**NAMED, "stop": "joints"}, {**ONE, "stop": "nothing"}], [1, 2]),
        ({}, [{**ONE, "stop": "zeros"}], []),
        # One of several numbers may be the gripper's, but which one is not known.
        ({}, [{**ONE, "numbers": 2, "stop": "joints"}], []),
        ({}, [{**ONE, "numbers": 2, "stop": "joints", "grippers": [1]}], [1]),
    ],
)
def test_grippers_are_found_by_their_names_among_all_topics(
    change: dict[str, Any], actions: list[dict[str, Any]], grippers: list[int]
) -> None:
    settings = settings_from({**ARM, **change, "actions": actions}, "arm.yaml")
    assert settings.grippers == grippers
