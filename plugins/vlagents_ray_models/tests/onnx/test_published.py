"""Models that others published, behind a replica's queue, against ONNX Runtime called as their
authors call it.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest
from generated import RATES
from in_process_replicas import Replicas

from vlagents_ray import Act, Obs
from vlagents_ray.policies.agent_copies import AgentCopies
from vlagents_ray.serve.python_env.create import install
from vlagents_ray_models.onnx import Onnx

pytestmark = pytest.mark.integration  # downloads 20 MB
PACKAGES = ("holosoma-inference==0.1.3", "silero-vad==6.2.3")
STEPS, SESSIONS = 50, 32
# An observation of holosoma's loco_g1_29dof, with the factors of its observation config as 1 / std.
WALK = {
    "actions": 29,
    "base_ang_vel": 3,
    "command_ang_vel": 1,
    "command_lin_vel": 2,
    "cos_phase": 2,
    "dof_pos": 29,
    "dof_vel": 29,
    "projected_gravity": 3,
    "sin_phase": 2,
}
STD = {"base_ang_vel": 4.0, "dof_vel": 20.0}
STAND = np.linspace(-0.4, 0.6, 29).astype(np.float32)  # rad, default joint angles


@pytest.fixture(scope="module")
def packages(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Install the packages without what they depend on, since only their files are needed."""
    folder = tmp_path_factory.mktemp("packages")
    install(Path(sys.executable), ["--no-deps", "--target", str(folder), *PACKAGES])
    return folder


class Walk:
    """Holosoma's locomotion policies, of one row, as its `BasePolicy.rl_inference` runs them."""

    def __init__(self, file: str) -> None:
        self.lengths = {name: length for name, length in WALK.items() if name != "actions"}
        self.file = f"holosoma_inference/models/loco/{file}.onnx"
        self.settings = {
            "state": ["previous_output" if name == "actions" else name for name in WALK],
            "inputs": {"actor_obs": {"std": STD, "mean": {"dof_pos": STAND.tolist()}}},
            "action": {"mean": STAND.tolist(), "std": 0.25, "clip": [-100, 100]},
            "contract": {"control_hz": 50},
        }

    def begin(self, session: onnxruntime.InferenceSession) -> None:
        self._session, self._last = session, np.zeros((1, 29), np.float32)

    def act(self, obs: Obs) -> np.ndarray:
        values = {**obs.state, "actions": self._last[0]}
        values["dof_pos"] = values["dof_pos"] - STAND
        scaled = [values[name] / np.float32(STD.get(name, 1)) for name in WALK]
        [action] = self._session.run(None, {"actor_obs": np.concatenate(scaled)[None]})
        self._last = np.clip(action, -100, 100)
        return self._last * np.float32(0.25) + STAND


class Dance:
    """Holosoma's whole-body tracking policies, whose motion is a function of the time step."""

    def __init__(self, file: str) -> None:
        self.file = f"holosoma_inference/models/wbt/{file}.onnx"
        self.lengths = {"actor_obs": 154}
        self.settings = {
            "state": ["actor_obs"],
            "inputs": {"time_step": {"step": 0}},
            "action": {"output": "actions"},
            "info": ["joint_pos", "joint_vel", "ref_pos_xyz", "ref_quat_xyzw"],
        }

    def begin(self, session: onnxruntime.InferenceSession) -> None:
        self._session, self._step = session, 0

    def act(self, obs: Obs) -> np.ndarray:
        feed = {
            "obs": obs.state["actor_obs"][None],
            "time_step": np.array([[self._step]], np.float32),
        }
        self._step += 1
        return self._session.run(["actions"], feed)[0]


class Speech:
    """Silero's voice activity detector. It is no policy of a robot, but recurrent, and its state
    has the batch in its second dimension.
    """

    def __init__(self, file: str, *, one_row: bool = False) -> None:
        self.file = f"silero_vad/data/{file}.onnx"
        self.lengths = {"audio": 576}
        self._has_rate = not one_row
        inputs = {"input": {"shape": [-1, 576]}, "sr": {"constant": 16000}}
        self.settings = {
            "state": ["audio"],
            "recurrent": {"state": "stateN"},
            "inputs": {} if one_row else inputs,
        }

    def begin(self, session: onnxruntime.InferenceSession) -> None:
        self._session, self._state = session, np.zeros((2, 1, 128), np.float32)

    def act(self, obs: Obs) -> np.ndarray:
        rate = {"sr": np.array(16000)} if self._has_rate else {}
        feed = {"input": obs.state["audio"][None], "state": self._state, **rate}
        probability, self._state = self._session.run(None, feed)
        return probability


MODELS = [
    pytest.param(lambda: Walk("g1_29dof/ppo_g1_29dof"), False, id="walk-g1-ppo"),
    pytest.param(lambda: Walk("g1_29dof/fastsac_g1_29dof"), False, id="walk-g1-fastsac"),
    pytest.param(lambda: Walk("t1_29dof/ppo_t1_29dof"), False, id="walk-t1-ppo"),
    pytest.param(lambda: Walk("t1_29dof/fastsac_t1_29dof"), False, id="walk-t1-fastsac"),
    pytest.param(lambda: Dance("ppo_g1_29dof_dancing"), False, id="dance-ppo"),
    pytest.param(lambda: Dance("fastsac_g1_29dof_dancing"), False, id="dance-fastsac"),
    pytest.param(lambda: Speech("silero_vad"), True, id="speech"),
    pytest.param(
        lambda: Speech("silero_vad_openvino_16k", one_row=True), False, id="speech-one-row"
    ),
]


def test_the_table_states_as_many_as_there_are() -> None:
    assert RATES["onnx"]["equal"] == len(MODELS)


def random_observations(model: Any, seed: int) -> list[Obs]:
    rng = np.random.default_rng(seed)
    observations = []
    for _ in range(STEPS):
        state = {}
        for name, length in model.lengths.items():
            state[name] = rng.normal(size=length).astype(np.float32) / 4
        observations.append(Obs(state=state))
    return observations


def called_directly(model: Any, file: Path, views: list[Obs]) -> list[np.ndarray]:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.log_severity_level = 1, 3
    model.begin(onnxruntime.InferenceSession(file, options))
    return [model.act(obs) for obs in views]


@pytest.mark.parametrize(("make", "batched"), MODELS)
def test_a_published_model_is_served_to_the_bit(packages: Path, make: Any, batched: bool) -> None:
    model = make()
    views = random_observations(model, 0)
    settings = {"checkpoint": str(packages / model.file), **model.settings}
    replicas = Replicas([Onnx.from_config(settings)])
    try:
        agent = replicas.agent()
        agent.reset(views[0], None)
        actions = [agent.act(obs).action for obs in views]
        agent.close()
    finally:
        replicas.close()
    np.testing.assert_array_equal(actions, called_directly(model, packages / model.file, views))


@pytest.mark.parametrize(("make", "batched"), MODELS)
def test_sessions_share_a_batch_of_it(packages: Path, make: Any, batched: bool) -> None:
    model = make()
    views = [random_observations(model, seed) for seed in range(SESSIONS)]
    policy = Onnx.from_config({"checkpoint": str(packages / model.file), **model.settings})
    policy.initialize()
    assert policy.model.batched == batched

    copies = AgentCopies(policy)
    sessions = [copies.make() for _ in range(SESSIONS)]
    expected = []
    for session, session_views in zip(sessions, views, strict=True):
        session.reset(session_views[0], None)
        expected.append(called_directly(model, packages / model.file, session_views))

    for step in range(STEPS):
        acts = policy.act_batch([session_views[step] for session_views in views], sessions)
        for act, actions in zip(acts, expected, strict=True):
            assert isinstance(act, Act)
            tolerance = 1e-6 if batched else 0
            np.testing.assert_allclose(act.action, actions[step], rtol=0, atol=tolerance)
