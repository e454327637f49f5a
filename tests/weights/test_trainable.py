"""The named values of numpy trees and torch modules, and pushed values that do not fit."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest
from fake_jax import Array, Gpu
from hypothesis import given
from hypothesis import strategies as st

from vlagents_ray.errors import InvalidWeights, NotTrainable, UnchangedWeights
from vlagents_ray.interface import Act, Agent, Obs, TrainableAgent
from vlagents_ray.policies.wrapper import require_trainable
from vlagents_ray.weights import trainable
from vlagents_ray.weights.trainable import (
    accepted,
    completed,
    converted,
    dtype_name,
    evaluation_mode,
    fingerprint,
    named_values,
    portable,
    set_values,
)


class Linear(TrainableAgent):
    """A policy that acts with a tree of numpy arrays."""

    trainable: ClassVar[str | None] = "tree"

    def initialize(self) -> None:
        self.tree = {
            "layers": [{"w": np.eye(2, dtype=np.float32)}],
            "bias": np.zeros(2, np.float32),
        }

    def act(self, obs: Obs) -> Act:
        return Act(self.tree["layers"][0]["w"] @ np.ones(2, np.float32) + self.tree["bias"])  # type: ignore[index,call-overload]


def test_values_of_a_tree_are_named_by_their_keys_and_replaced_in_the_same_dicts() -> None:
    agent = Linear()
    agent.initialize()
    tree = agent.tree
    assert list(agent.parameters()) == ["layers/0/w", "bias"]
    agent.load_parameters({"bias": np.full(2, 3, np.float32)})
    assert agent.tree is tree
    np.testing.assert_array_equal(agent.act(Obs()).action, [4, 4])


def test_sessions_share_what_is_trainable() -> None:
    agent = Linear()
    agent.initialize()
    assert agent.shared_objects() == [agent.tree]


def test_what_is_trainable_may_be_inside_of_what_sessions_share() -> None:
    class Deep(Linear):
        shared = ("model",)
        trainable = "model.tree"

        def initialize(self) -> None:
            super().initialize()
            self.model = SimpleNamespace(tree=self.tree)

    agent = Deep()
    agent.initialize()
    assert agent.shared_objects() == [agent.model]
    agent.load_parameters({"bias": np.full(2, 3, np.float32)})
    np.testing.assert_array_equal(agent.act(Obs()).action, [4, 4])


def test_an_agent_that_names_nothing_to_train_says_how_to() -> None:
    with pytest.raises(NotTrainable, match="set `trainable`"):
        TrainableAgent().parameters()
    with pytest.raises(NotTrainable, match="set `trainable` to the name"):
        require_trainable(Agent())
    with pytest.raises(NotTrainable, match=r"expected .*, got tuple"):
        named_values({"layers": (np.zeros(1),)})


def test_what_the_learner_writes_later_does_not_reach_the_policy() -> None:
    mine = np.ones(3, np.float32)
    for pushed in (mine, mine[:], np.broadcast_to(mine, (3,))):
        theirs = converted(pushed, np.zeros(3, np.float32))
        mine += 1
        assert theirs[0] == mine[0] - 1


def test_read_only_memory_is_taken_without_a_copy() -> None:
    pushed = np.frombuffer(np.ones(3, np.float32).tobytes(), np.float32)
    assert np.shares_memory(converted(pushed, np.zeros(3, np.float32)), pushed)


@pytest.mark.torch
class TestTorch:
    """Modules of torch."""

    @pytest.fixture
    def module(self) -> Any:
        torch = pytest.importorskip("torch")
        module = torch.nn.Sequential(torch.nn.Linear(3, 2), torch.nn.BatchNorm1d(2))
        module.tied = module[0].weight
        return module.eval()

    def test_values_are_those_of_the_state_dict_buffers_and_tied_ones_included(
        self, module: Any
    ) -> None:
        import torch

        parameter, held = module[0].weight, named_values(module)
        assert list(held) == list(module.state_dict())
        assert {"tied", "1.running_mean"} <= held.keys()
        new = {name: value + 1 for name, value in held.items()}
        set_values(module, new)
        assert module[0].weight is parameter
        assert module[0].weight.data_ptr() == new["0.weight"].data_ptr()
        torch.testing.assert_close(module.state_dict(), new, rtol=0, atol=0)

    def test_extra_state_of_a_module_is_not_trained(self, module: Any) -> None:
        import torch

        class WithState(torch.nn.Linear):
            def get_extra_state(self) -> Any:
                return {"version": 1}

            def set_extra_state(self, state: Any) -> None:
                """Do nothing."""

        assert set(named_values(WithState(2, 2))) == {"weight", "bias"}

    def test_tensors_and_arrays_become_the_policys_type(self, module: Any) -> None:
        import torch

        held = torch.zeros(2, dtype=torch.bfloat16)
        mine = torch.ones(2, dtype=torch.bfloat16)
        theirs = converted(mine, held)
        mine += 1
        for value in (theirs, converted(np.ones(2), held), converted(torch.ones(2), held)):
            assert value.dtype == torch.bfloat16
            assert value.tolist() == [1, 1]
        assert converted(mine, np.zeros(2, np.float32)).tolist() == [2, 2]

    def test_bfloat16_travels_as_bytes(self, module: Any) -> None:
        import torch

        mine = torch.tensor([1.5, -2.0, 3.0], dtype=torch.bfloat16)
        sent = np.frombuffer(portable(mine).tobytes(), portable(mine).dtype)
        assert dtype_name(sent) == "bfloat16"
        theirs = converted(sent, torch.zeros(3, dtype=torch.bfloat16))
        assert torch.equal(theirs, mine)
        assert theirs.data_ptr() == sent.ctypes.data
        for held in (np.zeros(3, np.float32), torch.zeros(3)):
            assert converted(sent, held).tolist() == [1.5, -2.0, 3.0]
        assert portable(torch.ones(2)).dtype == np.float32


HELD = {
    "w": np.zeros((2, 3), np.float32),
    "b": np.zeros(3, np.float16),
    "n": np.zeros((), np.int64),
}
LARGE = np.zeros(10_000, np.float32)
NEW = {"w": np.ones((2, 3), np.float32), "b": np.ones(3, np.float16), "n": np.ones((), np.int64)}


def fitted(
    held: Any, pushed: Any, *, partial: bool = False, allow_same: bool = False
) -> dict[str, Any]:
    return completed(held, accepted(held, pushed, partial=partial), allow_same=allow_same)


@pytest.mark.parametrize(
    ("pushed", "says"),
    [
        (NEW | {"z": np.zeros(1)}, r"'z': expected one of the policy's 3 names"),
        ({"w": NEW["w"]}, r"'b': missing; push it, or set partial=True; 'n': missing"),
        (NEW | {"w": np.ones((3, 2), np.float32)}, r"'w': expected shape \(2, 3\), got \(3, 2\)"),
        (NEW | {"w": np.ones((2, 3), np.int32)}, r"'w': expected float32, got int32"),
        (NEW | {"w": [1.0]}, r"'w': expected an array, got list"),
        (
            NEW | {"w": np.full((2, 3), np.nan, np.float32)},
            r"'w': expected finite values, got NaN or infinity",
        ),
        # Above the largest float16.
        (
            NEW | {"b": np.full(3, 1e5, np.float32)},
            r"'b': expected finite values, got NaN or infinity",
        ),
        ({**{str(n): np.zeros(1) for n in range(7)}, **NEW}, r"and 2 more$"),
    ],
)
def test_what_does_not_fit_is_refused(pushed: dict[str, Any], says: str) -> None:
    with np.errstate(over="ignore"), pytest.raises(InvalidWeights, match=says) as refused:
        fitted(HELD, pushed)
    assert "nothing was changed" in str(refused.value)


@pytest.mark.torch
@pytest.mark.parametrize("dtype", ["float32", "float16", "bfloat16", "float64"])
@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("place", [0, 1234, -1])
def test_one_number_that_is_not_finite_is_found_among_many_tensors(
    dtype: str, value: float, place: int
) -> None:
    torch = pytest.importorskip("torch")
    kind = getattr(torch, dtype)
    held = {str(i): torch.zeros(3000, dtype=kind) for i in range(4)}
    held |= {
        "empty": torch.zeros(0),
        "count": torch.zeros(2, dtype=torch.int64),
        "other": torch.zeros(5),
    }
    pushed = {name: one + 1 for name, one in held.items()}
    pushed["3"][:] = torch.finfo(kind).max  # its norms of other orders are infinite
    assert set(trainable.accepted(held, pushed)) == set(held)
    pushed["2"][place] = value
    with pytest.raises(
        InvalidWeights,
        match=r"nothing was changed: '2': expected finite values, got NaN or infinity$",
    ):
        trainable.accepted(held, pushed)


def test_infinite_values_fit_where_the_policy_has_them() -> None:
    mask = np.triu(np.full((2, 2), -np.inf, np.float32), 1)  # a mask of causal attention
    assert (
        fitted(HELD | {"mask": mask}, NEW | {"mask": mask.copy()})["mask"].tolist() == mask.tolist()
    )
    for wrong in (mask.T, -mask, np.full_like(mask, np.nan)):
        with pytest.raises(
            InvalidWeights, match="'mask': expected finite values, got NaN or infinity"
        ):
            fitted(HELD | {"mask": mask}, NEW | {"mask": wrong})


def test_what_fits_is_converted() -> None:
    new = fitted(HELD, NEW | {"b": np.ones(3, np.float64)})
    assert list(new) == list(HELD)
    assert {name: value.dtype for name, value in new.items()} == {
        name: value.dtype for name, value in HELD.items()
    }


def test_a_part_keeps_the_rest() -> None:
    new = fitted(HELD, {"b": NEW["b"]}, partial=True)
    assert new["w"] is HELD["w"]
    assert new["b"].tolist() == [1, 1, 1]
    with pytest.raises(InvalidWeights, match="no value"):
        fitted(HELD, {}, partial=True)


def test_what_changes_nothing_is_refused_unless_allowed() -> None:
    same = {name: value.copy() for name, value in HELD.items()}
    with pytest.raises(UnchangedWeights, match="got 3 equal ones"):
        fitted(HELD, same)
    assert fitted(HELD, same, allow_same=True)
    # One value suffices for values that share memory.
    assert fitted(HELD, same | {"n": np.int64(7)})


def test_the_fingerprint_depends_on_names_shapes_types_and_values_alone() -> None:
    first = fingerprint(HELD)
    assert len(first) == 32
    assert fingerprint(dict(reversed(HELD.items()))) == first
    others = [
        NEW,
        HELD | {"n": np.int64(1)},
        HELD | {"w": np.zeros((3, 2), np.float32)},
        HELD | {"x": np.zeros(1)},
    ]
    assert len({first, *map(fingerprint, others)}) == 5


@given(index=st.integers(0, 9_999), bits=st.integers(1, 2**32 - 1))
def test_no_element_can_be_changed_without_the_fingerprint(index: int, bits: int) -> None:
    other = LARGE.copy()
    other.view(np.uint32)[index] ^= bits
    assert fingerprint({"w": LARGE}) != fingerprint({"w": other})


LIBRARIES: dict[str, Callable[[np.ndarray], Any]] = {
    "numpy": np.copy,
    "JAX": lambda values: Array(values, "gpu:0"),
    "torch": lambda values: pytest.importorskip("torch").from_numpy(values.copy()),
}


@pytest.fixture(params=["numpy", "JAX", pytest.param("torch", marks=pytest.mark.torch)])
def of_library(
    request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> Callable[[np.ndarray], Any]:
    """Return a function that makes the values of a policy of one library."""
    Gpu().install(monkeypatch)
    return LIBRARIES[request.param]


@pytest.mark.parametrize("is_pushed_by_numpy", [False, True])
def test_values_of_each_library_are_checked_alike(
    of_library: Callable[[np.ndarray], Any], is_pushed_by_numpy: bool
) -> None:
    pushed_by = np.copy if is_pushed_by_numpy else of_library
    mask, zeros, ones = (
        np.array(values, np.float32) for values in ([1.0, -np.inf], [0.0, 0.0], [1.0, 1.0])
    )
    held = {"mask": of_library(mask), "b": of_library(zeros)}
    same = {"mask": pushed_by(mask), "b": pushed_by(zeros)}
    with pytest.raises(UnchangedWeights, match="got 2 equal ones"):
        fitted(held, same)
    assert fingerprint(fitted(held, same, allow_same=True)) == fingerprint(held)

    new = fitted(held, same | {"b": pushed_by(ones)})
    assert {name: type(value) for name, value in new.items()} == {
        name: type(value) for name, value in held.items()
    }
    assert np.asarray(new["b"]).tolist() == ones.tolist()
    assert fingerprint(new) != fingerprint(held)

    for name, wrong in (("mask", [1.0, np.inf]), ("b", [0.0, np.nan]), ("b", [-np.inf, 0.0])):
        values = pushed_by(np.array(wrong, np.float32))
        with pytest.raises(InvalidWeights, match=f"'{name}': expected finite values"):
            fitted(held, same | {name: values})


@pytest.mark.torch
def test_tensors_are_checked_as_arrays_are() -> None:
    torch = pytest.importorskip("torch")
    held = {"w": torch.zeros(4, dtype=torch.bfloat16), "n": torch.zeros((), dtype=torch.int64)}
    assert fitted(held, {"w": np.ones(4), "n": np.int64(2)})["w"].dtype == torch.bfloat16
    for wrong, says in (
        (torch.full((4,), float("inf")), "infinity"),
        (torch.ones(4, dtype=torch.int8), "got int8"),
    ):
        with pytest.raises(InvalidWeights, match=says):
            fitted(held, {"w": wrong}, partial=True)
    with pytest.raises(UnchangedWeights):
        fitted(held, held)
    assert fingerprint(held) != fingerprint(held | {"w": held["w"] + 1})


@pytest.mark.torch
def test_a_tree_may_have_modules() -> None:
    torch = pytest.importorskip("torch")
    network, head = torch.nn.Linear(2, 1).train(), {"scale": torch.ones(1)}
    tree = {"network": network, "head": head}
    assert list(named_values(tree)) == ["network/weight", "network/bias", "head/scale"]
    weight = network.weight
    set_values(
        tree, {"network/weight": torch.full((1, 2), 3.0), "head/scale": torch.full((1,), 4.0)}
    )
    assert network.weight is weight
    assert weight.tolist() == [[3, 3]]
    assert head["scale"].tolist() == [4]
    with evaluation_mode(tree):
        assert not network.training
    assert network.training
