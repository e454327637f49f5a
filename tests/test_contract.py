"""Contracts: each difference is reported with its cure, and undeclared fields are not compared."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from vlagents_ray.contract import (
    ActionSpec,
    CameraSpec,
    Contract,
    StateSpec,
    differences,
    require_match,
)
from vlagents_ray.errors import (
    ContractMismatch,
    InvalidAction,
    InvalidInput,
    InvalidObservation,
    MalformedMessage,
    MissingCamera,
    MissingState,
    NotOffered,
)
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.validation import (
    LARGEST_ACTION,
    check_action,
    check_observation,
    check_options,
)

POLICY = Contract(
    cameras={"front": CameraSpec(224, 224), "wrist": CameraSpec()},
    state={"joints": StateSpec(7, "rad")},
    gripper=True,
    instruction=True,
    action=ActionSpec(7, "ee_pose", True, "axis_angle", "base", 1.0, -1.0, -1.0, 1.0),
    control_hz=20,
    chunk=8,
    history=2,
)
ENV = replace(
    POLICY, cameras={**POLICY.cameras, "extra": CameraSpec(64, 64)}, chunk=None, history=None
)  # type: ignore[dict-item]
OBS = Obs(
    {"front": np.zeros((224, 224, 3), np.uint8), "wrist": np.zeros((32, 32, 3), np.uint8)},
    0.5,
    {"joints": np.zeros(7, np.float32)},
)


def test_a_fitting_pair_has_no_differences() -> None:
    assert differences(POLICY, ENV) == []


def test_what_is_not_stated_is_not_compared() -> None:
    require_match(Contract(), ENV)
    require_match(POLICY, Contract())
    require_match(None, ENV)


@pytest.mark.parametrize(
    ("env", "word"),
    [
        (replace(ENV, cameras={"front": CameraSpec(224, 224)}), "wrist"),
        (replace(ENV, cameras={"front": CameraSpec(256, 256), "wrist": CameraSpec()}), "256x256"),
        (replace(ENV, state={}), "joints"),
        (replace(ENV, state={"joints": StateSpec(9, "rad")}), "9"),
        (replace(ENV, state={"joints": StateSpec(7, "deg")}), "deg"),
        (replace(ENV, gripper=False), "gripper"),
        (replace(ENV, instruction=False), "instruction"),
        (replace(ENV, action=replace(ENV.action, dim=8)), "action.dim"),
        (replace(ENV, action=replace(ENV.action, rotation="euler_xyz")), "action.rotation"),
        (replace(ENV, action=replace(ENV.action, delta=False)), "action.delta"),
        (replace(ENV, action=replace(ENV.action, gripper_open=0.0)), "action.gripper_open"),
        (replace(ENV, action=replace(ENV.action, high=0.5)), "action.high"),
        (replace(ENV, action=replace(ENV.action, low=-0.5)), "action.low"),
        (replace(ENV, control_hz=10), "control_hz"),
        (replace(ENV, chunk=4), "chunk"),
    ],
)
def test_each_difference_is_named(env: Contract, word: str) -> None:
    found = differences(POLICY, env)
    assert len(found) == 1
    assert word in found[0]


@pytest.mark.parametrize(
    ("needed", "provided", "renamed"),
    [
        (
            ["top", "wrist"],
            ["images/top", "images/wrist"],
            {"top": "images/top", "wrist": "images/wrist"},
        ),
        (["top"], ["images/Top"], {"top": "images/Top"}),
        (["image"], ["wrist", "front"], {}),
        (["wrist_left"], ["images/wrist_right"], {}),
        (["rgb"], ["left/rgb", "right/rgb"], {}),
        (["images/top", "top"], ["images/top"], {}),
        (["top"], [], {}),
    ],
)
def test_the_cure_of_a_missing_camera_proposes_only_the_camera_of_that_name(
    needed: list[str], provided: list[str], renamed: dict[str, str]
) -> None:
    policy = replace(POLICY, cameras={name: CameraSpec() for name in needed})
    env = replace(ENV, cameras={name: CameraSpec() for name in provided})
    found = differences(policy, env)
    missing = [name for name in needed if name not in provided]
    assert len(found) == len(missing)
    for name, sentence in zip(missing, found, strict=True):
        assert sentence.startswith(f"camera {name!r}: ")
        assert sentence.count("{") == (name in renamed)
        if name in renamed:
            assert f"{{{name}: {renamed[name]}}}" in sentence


def test_all_differences_are_told_at_once() -> None:
    with pytest.raises(ContractMismatch) as caught:
        require_match(POLICY, replace(ENV, gripper=False, control_hz=5, state={}))
    assert str(caught.value).count("\n  - ") == 3


def test_a_wider_env_takes_a_narrower_policy() -> None:
    assert differences(POLICY, replace(ENV, action=replace(ENV.action, low=-2.0, high=2.0))) == []


def test_a_contract_survives_json() -> None:
    assert Contract.from_json(POLICY.to_json()) == POLICY
    assert Contract.from_json({}) == Contract()


def test_the_order_of_the_arms_survives_json_and_is_compared() -> None:
    env = Contract(action=ActionSpec(dim=14, arms=("left", "right")))
    again = Contract.from_json(json.loads(json.dumps(env.to_json())))
    assert again == env
    assert differences(Contract(action=ActionSpec(dim=14)), again) == []
    [found] = differences(Contract(action=ActionSpec(dim=14, arms=("right", "left"))), again)
    assert "put the arms' commands into the env's order" in found


def test_joints_in_another_order_are_found_by_the_names_that_both_sides_have() -> None:
    env = Contract(action=ActionSpec(names=("left_pan", "left_lift", "left_grip", "right_pan")))
    assert Contract.from_json(json.loads(json.dumps(env.to_json()))) == env
    assert "names" not in Contract().to_json()["action"], "older versions reject unknown fields"
    same = Contract(action=ActionSpec(names=("left_pan.pos", "left_lift.pos", "right_pan.pos")))
    assert differences(same, env) == []
    assert differences(Contract(action=ActionSpec(names=("joint1", "joint2"))), env) == [], (
        "other names must have no effect"
    )
    found = differences(
        Contract(action=ActionSpec(names=("left_lift", "left_pan", "right_pan"))), env
    )
    assert found[0] == (
        "action.names: number 0 is 'left_lift' in the policy and 'left_pan' in the env; use the same "
        "order"
    )
    assert len(found) == 2


def test_what_an_act_says_on_demand_survives_json_and_is_left_out_for_those_who_do_not_know_it() -> (
    None
):
    policy = Contract(behaviour=("logprob", "value"))
    assert Contract.from_json(json.loads(json.dumps(policy.to_json()))) == policy
    assert "behaviour" not in Contract().to_json()


@pytest.mark.parametrize(
    ("want", "error"),
    [
        (["logprob"], None),
        ([], None),
        (["value", "logprob"], NotOffered),
        ("logprob", InvalidObservation),
        ([1], InvalidObservation),
    ],
)
def test_only_what_the_contract_offers_may_be_wanted(
    want: object, error: type[Exception] | None
) -> None:
    obs, policy = Obs(info={"want": want}), Contract(behaviour=("logprob",))
    if error is None:
        check_observation(obs, policy)
        return
    with pytest.raises(error, match="info\\['want'\\]: expected "):
        check_observation(obs, policy)
    with pytest.raises(InvalidObservation):
        check_observation(obs, None)


@pytest.mark.parametrize(
    "data",
    [
        3,
        {"camera": {}},
        {"cameras": []},
        {"cameras": {"a": {"depth": 1}}},
        {"action": {"dims": 1}},
        {"action": {"arms": "left"}},
        {"action": {"arms": [1, 2]}},
        {"action": {"names": "pan"}},
        {"behaviour": "logprob"},
        {"state": {"a": {"dim": "3"}}},
        {"cameras": {"a": {"height": True}}},
        {"action": {"low": "abc"}},
        {"action": {"dim": 7.0}},
        {"action": {"delta": 1}},
        {"action": {"rotation": ["euler"]}},
        {"action": {"space": 3}},
        {"control_hz": {}},
        {"chunk": "8"},
        {"instruction": "yes"},
    ],
)
def test_an_unknown_key_or_a_value_of_another_type_in_a_contract_is_malformed(data: object) -> None:
    with pytest.raises(MalformedMessage):
        Contract.from_json(data)


def test_a_good_observation_passes() -> None:
    check_observation(OBS, POLICY)
    check_observation(OBS, None)


@pytest.mark.parametrize(
    ("obs", "error"),
    [
        (replace(OBS, cameras={}), MissingCamera),
        (replace(OBS, state={}), MissingState),
        (replace(OBS, gripper=None), InvalidObservation),
        (replace(OBS, gripper=1.5), InvalidObservation),
        (replace(OBS, state={"joints": np.full(7, np.nan, np.float32)}), InvalidObservation),
        (replace(OBS, state={"joints": np.zeros(6, np.float32)}), InvalidObservation),
        (replace(OBS, state={"joints": np.zeros((1, 7), np.float32)}), InvalidObservation),
        (
            replace(OBS, cameras={**OBS.cameras, "front": np.zeros((64, 64, 3), np.uint8)}),
            InvalidObservation,
        ),
        (
            replace(OBS, cameras={**OBS.cameras, "front": np.zeros((224, 224, 3), np.float32)}),
            InvalidObservation,
        ),
        (
            replace(OBS, cameras={**OBS.cameras, "front": np.zeros((3, 224, 224), np.uint8)}),
            InvalidObservation,
        ),
        (
            replace(OBS, cameras={**OBS.cameras, "unknown": np.zeros((0, 4, 3), np.uint8)}),
            InvalidObservation,
        ),
    ],
)
def test_each_bad_observation_has_its_error(obs: Obs, error: type[Exception]) -> None:
    with pytest.raises(error):
        check_observation(obs, POLICY)


@pytest.mark.parametrize("size", [1, 63, 64, 65, 4096])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_number_that_is_none_is_found_wherever_it_is(size: int, bad: float) -> None:
    for at in (0, size // 2, size - 1):
        part = np.zeros(size, np.float32)
        check_observation(Obs(state={"joints": part}), None)
        check_action(part, None)
        part[at] = bad
        with pytest.raises(InvalidObservation, match="NaN or infinity"):
            check_observation(Obs(state={"joints": part}), None)
        with pytest.raises(InvalidAction, match="NaN or infinity"):
            check_action(part.reshape(1, -1), None)


@pytest.mark.parametrize("size", [1, 63, 64, 65, 4096])
@pytest.mark.parametrize("sign", [1, -1])
def test_a_number_that_is_too_large_for_any_unit_is_found_wherever_it_is(
    size: int, sign: int
) -> None:
    for at in (0, size // 2, size - 1):
        action = np.zeros(size, np.float32)
        action[at] = sign * LARGEST_ACTION
        check_action(action, None)
        action[at] = sign * 1e30
        with pytest.raises(
            InvalidAction, match=r"expected numbers of at most 1e\+09, got a number of size 1e\+30"
        ):
            check_action(action, None)


@pytest.mark.parametrize("action", [[0.0] * 7, np.zeros((8, 7)), np.zeros(7, np.float64)])
def test_actions_become_float32(action: object) -> None:
    assert check_action(action, POLICY).dtype == np.float32


@pytest.mark.parametrize(
    "action", [None, "x", np.zeros(6), np.zeros((1, 1, 7)), np.full(7, np.inf), [], object()]
)
def test_an_unusable_action_never_gets_through(action: object) -> None:
    with pytest.raises(InvalidAction):
        check_action(action, POLICY)


def test_no_numpy_is_left_in_the_json_of_a_contract() -> None:
    told = Contract(
        action=ActionSpec(dim=1, low=np.float32(-1.0)), control_hz=np.float64(20.0)
    ).to_json()  # type: ignore[arg-type]
    assert (type(told["control_hz"]), type(told["action"]["low"])) == (float, float)


class TestAPolicyOfSeveralPartsServedAsOne:
    """`state` is not set, so one part contains all numbers with which the policy was trained."""

    ENV = Contract(
        state={
            "joints": StateSpec(7, "rad"),
            "tquat": StateSpec(7, "m+quat_xyzw"),
            "xyzrpy": StateSpec(6, "m+rad"),
        },
        gripper=True,
    )

    def test_the_parts_with_as_many_numbers_are_named(self) -> None:
        [told] = differences(Contract(state={"joints": StateSpec(21)}), self.ENV)
        assert told == (
            "state 'joints': the policy needs 21 numbers, the env provides 7; if it was trained on "
            "several parts, set the policy's `state` to them in the order of the training: "
            "[joints, tquat, xyzrpy, gripper] has 21 numbers here"
        )

    def test_the_parts_have_the_order_of_the_env(self) -> None:
        env = Contract(state={"xyz_axis_angle": StateSpec(6), "gripper_qpos": StateSpec(2)})
        [told] = differences(Contract(state={"joints": StateSpec(8)}), env)
        assert "[xyz_axis_angle, gripper_qpos] has 8 numbers" in told

    def test_all_choices_are_told_where_there_are_several(self) -> None:
        [told] = differences(Contract(state={"q": StateSpec(8)}), self.ENV)
        assert "the env provides ['joints', 'tquat', 'xyzrpy']" in told
        assert (
            "`state` to them in the order of the training: [joints, gripper] or [tquat, gripper] "
            "have 8 numbers here"
        ) in told

    def test_where_none_fit_the_policy_is_another_ones(self) -> None:
        [told] = differences(Contract(state={"joints": StateSpec(9)}), self.ENV)
        assert told.endswith("the env provides 7; is this another task's or robot's policy?")

    def test_where_the_parts_are_set_they_are_not_guessed(self) -> None:
        told = differences(
            Contract(state={"joints": StateSpec(21), "xyzrpy": StateSpec(6)}), self.ENV
        )
        assert told == [
            (
                "state 'joints': the policy needs 21 numbers, the env provides 7; is this "
                "another task's or robot's policy?"
            )
        ]


@pytest.mark.parametrize(
    ("cls", "wrong", "said"),
    [
        (CameraSpec, "hight", "CameraSpec: expected only ['height', 'width'], got ['hight'];"),
        (ActionSpec, "horizon", "the rows of a chunk are Contract(chunk=…)"),
        (Contract, "control_hertz", "did you mean 'control_hz'?"),
    ],
)
def test_an_unknown_field_is_refused_with_those_that_there_are(
    cls: type, wrong: str, said: str
) -> None:
    with pytest.raises(TypeError) as caught:
        cls(**{wrong: 1})
    assert said in str(caught.value)


def test_another_error_of_a_constructor_is_the_same_as_without_the_list_of_fields() -> None:
    with pytest.raises(TypeError, match="missing 1 required positional argument: 'action'"):
        Act()  # type: ignore[call-arg]


def test_a_tensor_that_numpy_cannot_read_is_no_action() -> None:
    class RequiresGrad:
        def __array__(self, *_: object, **__: object) -> np.ndarray:
            raise RuntimeError("Can't call numpy() on Tensor that requires grad")

    with pytest.raises(InvalidAction, match=r"expected .*, got RequiresGrad"):
        check_action(RequiresGrad(), None)


class TakesOptions(Agent):
    def reset(
        self, obs: Obs, instruction: str | None, *, weight: float = 1.0, **kwargs: Any
    ) -> dict[str, Any]:
        return {}


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("checkpoint", "a replica has only one"),
        ("checkpoint_step", "a replica has only one"),
        ("chekpoint", "did you mean 'checkpoint'"),
        ("checkpoint_steps", "did you mean 'checkpoint_step'"),
        ("weigths", "did you mean 'weights'"),
        ("weight", None),  # a parameter of this policy's `reset`
        ("seed", None),
        ("speed", None),
        ("env", None),
        ("temperature", None),
    ],
)
def test_an_option_of_a_reset_with_almost_the_name_of_a_known_one_is_refused(
    option: str, message: str | None
) -> None:
    if message is None:
        check_options(TakesOptions(), {option: 1})
        return
    with pytest.raises(InvalidInput, match=message):
        check_options(TakesOptions(), {option: 1})
    with pytest.raises(InvalidInput, match="did you mean 'weights'"):
        check_options(Agent(), {"weight": 1})
