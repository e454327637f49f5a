"""A policy type that another package registers with LeRobot is served one row at a time, with
independent sessions.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from plugins.vlagents_ray_models.tests.families.lerobot import tiny
from plugins.vlagents_ray_models.tests.families.lerobot.conftest import TASKS, begun, view
from vlagents_ray.errors import ConfigError
from vlagents_ray.testing import check_agent
from vlagents_ray_models.lerobot import LeRobot

PACKAGE = "lerobot_policy_wobble"
FILES = {
    "__init__.py": f"import {PACKAGE}.configuration_wobble\n",
    "configuration_wobble.py": """
from dataclasses import dataclass
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.act.configuration_act import ACTConfig

@PreTrainedConfig.register_subclass("wobble")
@dataclass
class WobbleConfig(ACTConfig):
    def __post_init__(self):
        PreTrainedConfig.__post_init__(self)
""",
    "modeling_wobble.py": f"""
import torch
from lerobot.policies.pretrained import PreTrainedPolicy
from {PACKAGE}.configuration_wobble import WobbleConfig

class WobblePolicy(PreTrainedPolicy):
    config_class, name = WobbleConfig, "wobble"

    def __init__(self, config, **kwargs):
        super().__init__(config)
        self.head = torch.nn.Linear(config.robot_state_feature.shape[0], config.action_feature.shape[0])
        self.reset()

    def reset(self):
        self.calls = 0

    def predict_action_chunk(self, batch, **kwargs):
        self.calls += 1  # state of the policy object, which no session may see
        chunk = self.head(batch["observation.state"])[:, None].expand(-1, self.config.chunk_size, -1)
        return chunk * self.calls + torch.randn_like(chunk)

    select_action = forward = get_optim_params = predict_action_chunk
""",
    "processor_wobble.py": """
from lerobot.policies.act.processor_act import make_act_pre_post_processors as make_wobble_pre_post_processors
""",
}


@pytest.fixture
def checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A checkpoint of a type in a separate package, which looks as if pip had installed it."""
    info = tmp_path / f"{PACKAGE}-1.dist-info"
    (tmp_path / PACKAGE).mkdir()
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {PACKAGE}\nVersion: 1\n")
    for name, text in FILES.items():
        (tmp_path / PACKAGE / name).write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))
    __import__(PACKAGE)
    chunk = {"chunk_size": tiny.CHUNK, "n_action_steps": tiny.EXECUTED}
    (tmp_path / "checkpoint").mkdir()
    return tiny.write(tmp_path / "checkpoint", tiny.config_of("wobble", **chunk))


def test_an_unknown_type_is_served_row_by_row_and_refused_if_it_keeps_a_history(
    checkpoint: Path,
) -> None:
    check_agent(LeRobot.from_config({"checkpoint": str(checkpoint)}), instructions=TASKS)
    policy = LeRobot.from_config({"checkpoint": str(checkpoint)})
    policy.initialize()
    session = begun(policy)
    first, second = session.act(view()).action, session.act(view()).action
    assert first.shape == (tiny.EXECUTED, tiny.ACTION)
    assert not np.allclose(first, second, atol=1e-3)  # each call draws other numbers
    with pytest.raises(ConfigError, match="by itself"):
        LeRobot.from_config(
            {"checkpoint": str(checkpoint), "overrides": {"n_obs_steps": 2}}
        ).initialize()
