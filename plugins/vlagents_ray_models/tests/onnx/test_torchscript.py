"""Policies from TorchScript archives, by the same settings as ONNX files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vlagents_ray import Act, Obs
from vlagents_ray.errors import ConfigError
from vlagents_ray.policies.agent_copies import AgentCopies
from vlagents_ray.testing import check_agent
from vlagents_ray_models.onnx import Onnx

# torch deprecates TorchScript, in which policies are exported all the same.
pytestmark = [pytest.mark.torch, pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning")]
SETTINGS = {
    "trust_checkpoint": True,
    "state": ["joints"],
    "outputs": ["action", "h_out"],
    "recurrent": {"h": "h_out"},
    "inputs": {"x": {"shape": [-1, 4]}, "h": {"shape": [1, -1, 8]}},
}


@pytest.fixture(scope="module")
def archives(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a GRU whose state is an input and an output, and one that keeps its state in a buffer,
    as rsl_rl exports it.
    """
    import torch

    class Explicit(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.gru, self.head = torch.nn.GRU(4, 8), torch.nn.Linear(8, 3)

        def forward(self, x: torch.Tensor, h: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            output, next_h = self.gru(x.unsqueeze(0), h)
            return self.head(output[0]), next_h

    class Hidden(Explicit):
        def __init__(self) -> None:
            super().__init__()
            self.register_buffer("hidden", torch.zeros(1, 1, 8))

        def forward(self, x: torch.Tensor) -> torch.Tensor:  # type: ignore[override]
            output, next_hidden = self.gru(x.unsqueeze(0), self.hidden)
            self.hidden[:] = next_hidden
            return self.head(output[0])

    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("archives")
    torch.jit.script(Explicit()).save(str(folder / "explicit.pt"))
    torch.jit.script(Hidden()).save(str(folder / "hidden.pt"))
    return folder


def policy(file: Path, **settings: Any) -> Onnx:
    loaded = Onnx.from_config({"checkpoint": str(file), **SETTINGS, **settings})
    loaded.initialize()
    return loaded


def test_sessions_of_a_batch_act_as_the_archive_alone(archives: Path) -> None:
    import torch

    module = torch.jit.load(str(archives / "explicit.pt"))
    served = policy(archives / "explicit.pt")
    assert (served.model.batched, served.contract.action.dim) == (True, 3)
    copies = AgentCopies(served)
    sessions = [copies.make() for _ in range(32)]
    for session in sessions:
        session.reset(Obs(), None)

    rng = np.random.default_rng(0)
    hidden = [torch.zeros(1, 1, 8) for _ in sessions]
    for _ in range(10):
        joints = rng.normal(size=(32, 4)).astype(np.float32)
        observations = [Obs(state={"joints": row}) for row in joints]
        for i, act in enumerate(served.act_batch(observations, sessions)):
            assert isinstance(act, Act)
            with torch.inference_mode():
                expected, hidden[i] = module(torch.from_numpy(joints[i : i + 1]), hidden[i])
            np.testing.assert_allclose(act.action, expected.numpy(), atol=1e-6)


def test_a_suite_of_the_interface_accepts_it(archives: Path) -> None:
    check_agent(Onnx.from_config({"checkpoint": str(archives / "explicit.pt"), **SETTINGS}))


@pytest.mark.parametrize(
    ("file", "settings", "message"),
    [
        (
            "explicit.pt",
            {"trust_checkpoint": False},
            r"is a program, .* set trust_checkpoint: true",
        ),
        (
            "explicit.pt",
            {"inputs": {"x": {"shape": [-1, 4]}}},
            r"inputs: h: shape: expected all lengths .*got None, and none in the file",
        ),
        (
            "explicit.pt",
            {"outputs": ["action"], "recurrent": {}},
            r"inputs without a source: \['x', 'h'\]",
        ),
        (
            "explicit.pt",
            {"outputs": ["action", "h_out", "c"], "info": ["c"]},
            "expected names for the 2 results",
        ),
        (
            "hidden.pt",
            {"outputs": ["action"], "recurrent": {}, "inputs": {"x": {"shape": [1, 4]}}},
            "keeps a state",
        ),
    ],
)
def test_an_archive_that_cannot_be_served_is_refused_at_the_start(
    archives: Path, file: str, settings: Any, message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        policy(archives / file, **settings)


def test_bytes_that_are_no_archive_are_refused(tmp_path: Path) -> None:
    (tmp_path / "policy.pt").write_bytes(b"PK nothing")
    with pytest.raises(ConfigError, match=r"torch.jit.load cannot read it"):
        policy(tmp_path / "policy.pt")
