"""Observations and actions of vlagents 0.2 and 0.3."""

from __future__ import annotations

import base64
import contextlib
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rpyc_client import document

from vlagents_ray.errors import InvalidObservation, MalformedMessage, MessageTooLarge, VLAgentsError
from vlagents_ray.images.jpeg_png import encode_jpeg
from vlagents_ray.interface import GOAL_IMAGE, Act
from vlagents_ray.protocol.messages import Budget, Limits
from vlagents_ray.wire import json_numpy, vlagents

LIMITS = Limits()


JPEG = encode_jpeg(np.full((32, 24, 3), 200, np.uint8))


class Memory:
    """Segments by name."""

    def __init__(self, **segments: bytes) -> None:
        self.segments = segments

    def read(self, name: str, size: int) -> bytearray:
        if name not in self.segments:
            raise InvalidObservation(f"no {name}")
        return bytearray(self.segments[name][:size])


def act(value: object, memory: Memory | None = None, limits: Limits = LIMITS) -> vlagents.ObservationRequest:
    text = value if isinstance(value, str) else json_numpy.dumps(value)
    return vlagents.read_act(text, Budget(limits), memory or Memory())


def test_one_robot_keeps_its_names() -> None:
    seen = act(document(7, "pick", value=3))
    assert (seen.instruction, seen.robots, seen.obs.gripper) == ("pick", ("arm",), 0.25)
    assert seen.obs.cameras["front"].shape == (16, 16, 3)
    assert seen.obs.cameras["front"].max() == 7
    assert seen.obs.state["joints"].tolist() == [0.5] * 7
    assert seen.obs.info == {"value": 3}


def test_several_robots_have_their_names_in_front() -> None:
    arm = {"cameras": {"wrist": np.zeros((4, 4, 3), np.uint8)}, "joints": np.zeros(2, np.float32), "gripper": 1.0}
    seen = act({"obs": {"left": arm, "right": arm}, "language_instruction": None})
    assert sorted(seen.obs.cameras) == ["left/wrist", "right/wrist"]
    assert sorted(seen.obs.state) == ["left/gripper", "left/joints", "right/gripper", "right/joints"]
    assert seen.obs.gripper is None


def test_jpeg_and_shared_memory_become_pixels() -> None:
    image = np.full((32, 24, 3), 200, np.uint8)
    jpeg = base64.urlsafe_b64encode(encode_jpeg(image)).decode()
    shared = {"shm_name": "psm_1", "shape": [32, 24, 3], "dtype": "uint8"}
    robot = {"cameras": {"a": jpeg}, "camera_data_type": "jpeg_encoded"}
    goal = {"goal_image": shared, "goal_image_data_type": "shared_memory"}
    seen = act({"obs": {"arm": robot}, **goal}, Memory(psm_1=image.tobytes() + b"more"))
    assert abs(int(seen.obs.cameras["a"][5, 5, 0]) - 200) <= 2
    assert np.array_equal(seen.obs.info[GOAL_IMAGE], image)


def test_the_error_of_an_image_names_its_camera() -> None:
    good, broken = (base64.urlsafe_b64encode(file).decode() for file in (JPEG, JPEG[:-20]))
    robot = {"cameras": {"side": good, "wrist": broken}, "camera_data_type": "jpeg_encoded"}
    with pytest.raises(MalformedMessage, match="camera 'wrist': broken JPEG"):
        act({"obs": {"arm": robot}})


def test_of_several_frames_the_last_is_taken() -> None:
    frames = np.stack([np.full((4, 4, 3), i, np.uint8) for i in range(3)])
    assert act({"obs": {"arm": {"cameras": {"a": frames}}}}).obs.cameras["a"].max() == 2


def test_a_reset_of_0_2_brings_instruction_and_options() -> None:
    old = {"cameras": {}, "camera_data_type": "raw", "gripper": None, "state": np.ones(3), "info": {}}
    episode = vlagents.read_reset(json_numpy.dumps([old, "go", {"seed": 4}]), Budget(LIMITS), Memory())
    assert (episode.seen.instruction, episode.kwargs, episode.seen.robots) == ("go", {"seed": 4}, ())
    assert episode.seen.obs.state["state"].dtype == np.float32
    for options in ({"obs": 1}, {"contract": {}}, 3):
        with pytest.raises(MalformedMessage, match="options"):
            vlagents.read_reset(json_numpy.dumps([old, "go", options]), Budget(LIMITS), Memory())


def test_rows_become_steps_and_the_gripper_has_a_place_of_its_own() -> None:
    rows = np.array([[1, 2, -1], [3, 4, 1]], np.float32)
    parts = {"arm": vlagents.Part(gripper=-1, gripper_open=-1.0, gripper_closed=1.0)}
    acts = json.loads(vlagents.write_act(Act(rows, True, {"a": 1}), ["arm"], parts))["acts"]
    assert [step["arm"]["gripper"] for step in acts] == [1.0, 0.0]
    assert [step["arm"]["done"] for step in acts] == [False, True]
    assert [step["arm"]["info"] for step in acts] == [{"a": 1}, {}]
    assert acts[0]["arm"]["action"]["shape"] == [2]


def test_columns_are_shared_out_among_robots() -> None:
    parts = {"left": vlagents.Part(0, 2, 1), "right": vlagents.Part(2, 4)}
    [step] = json.loads(vlagents.write_act(Act(np.arange(4.0)), ["left", "right"], parts))["acts"]
    assert step["left"]["action"]["shape"] == [1]
    assert step["left"]["gripper"] == 1.0
    assert step["right"]["action"]["shape"] == [2]


def robot(**changes: object) -> dict:
    return {"obs": {"arm": {"cameras": {}, "camera_data_type": "raw"} | changes}}


def shared(shape: list[int]) -> dict:
    return robot(cameras={"a": {"shm_name": "psm_9", "shape": shape}}, camera_data_type="shared_memory")


@pytest.mark.parametrize(
    ("value", "error"),
    [
        (robot(cameras={"a": "x"}, camera_data_type="jpeg_encoded"), MalformedMessage),
        (robot(cameras={"a": "x"}), InvalidObservation),
        (robot(cameras={"a": np.zeros((4, 4), np.uint8)}), InvalidObservation),
        (shared([2, 2, 3]), InvalidObservation),
        (shared([2**40, 2**40, 3]), MessageTooLarge),
        (shared([-1]), MalformedMessage),
        (robot(camera_data_type="pickle", cameras={"a": "x"}), MalformedMessage),
        (robot(joints="x"), InvalidObservation),
        (robot(gripper="x"), InvalidObservation),
        (robot(more=1), MalformedMessage),
        ({"obs": {}}, InvalidObservation),
        ({"obs": {"arm": {}}, "language_instruction": 3}, MalformedMessage),
        ({"obs": {"arm": {}}, "language_instruction": "x" * 100_000}, MessageTooLarge),
        ("[" * 100_000, MessageTooLarge),
        ("[" * 5_000, MalformedMessage),
        ('{"__numpy__": "AAAA", "dtype": "|O8", "shape": [1]}', MalformedMessage),
        ('{"__numpy__": "AAAA", "dtype": "|u1", "shape": [4000000000]}', MalformedMessage),
        ('{"__numpy__": "AAAA", "dtype": [["a", "<f4"]], "shape": [1]}', MalformedMessage),
        ("nonsense", MalformedMessage),
    ],
)  # fmt: skip
def test_what_is_wrong_is_refused_by_name(value: object, error: type[Exception]) -> None:
    with pytest.raises(error):
        act(value)


def test_the_cameras_of_all_robots_are_counted_before_one_is_decoded() -> None:
    file = base64.b64encode(encode_jpeg(np.zeros((8, 8, 3), np.uint8))).decode()
    one = {"cameras": {f"c{i}": file for i in range(9)}, "camera_data_type": "jpeg_encoded"}
    with pytest.raises(MessageTooLarge, match="cameras: got 18"):
        act({"obs": {"left": one, "right": one}})


def test_a_document_of_too_many_values_is_refused() -> None:
    with pytest.raises(MessageTooLarge, match="values"):
        act(robot(info={"list": [0] * 20_000}))


@given(st.data())
def test_a_mutated_document_is_read_or_refused(data: st.DataObject) -> None:
    text = list(document())
    for _ in range(data.draw(st.integers(1, 5))):
        text[data.draw(st.integers(0, len(text) - 1))] = data.draw(st.sampled_from('{}[]":,0eN-_=\\ \n9ax'))
    with contextlib.suppress(VLAgentsError):
        act("".join(text))


arrays = st.sampled_from([np.float32, np.float64, np.uint8, np.int64, np.bool_]).flatmap(
    lambda dtype: st.lists(st.integers(0, 1), max_size=6).map(lambda values: np.array(values, dtype))
)


@given(st.recursive(arrays | st.none() | st.booleans() | st.integers() | st.text(), st.lists, max_leaves=8))
def test_json_with_arrays_comes_back(value: object) -> None:
    found = json_numpy.loads(json_numpy.dumps(value), LIMITS)
    assert json_numpy.dumps(found) == json_numpy.dumps(value)


def test_a_scalar_and_a_big_endian_array_keep_their_values() -> None:
    found = json_numpy.loads(json_numpy.dumps([np.float32(2.5), np.array([1, 2], ">i4")]), LIMITS)
    assert found[0] == 2.5
    assert found[1].tolist() == [1, 2]
