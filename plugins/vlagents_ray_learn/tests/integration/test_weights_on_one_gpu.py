"""New weights for two replicas from a learner on their GPU, or from one whose memory on the CPU
takes its place.
"""

from __future__ import annotations

import logging
from typing import Any

import pytest
from served_acts import first_act
from shared_cpu_memory import SharedCpuMemory
from shared_ray import shared_server

from vlagents_ray.errors import InvalidWeights
from vlagents_ray.serve.launch.deployment_file import deployment
from vlagents_ray.weights import shared_values
from vlagents_ray.weights.shared_values import SharedValues
from vlagents_ray_learn import Publisher
from vlagents_ray_learn.publisher import AppTarget

pytestmark = pytest.mark.torch


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def test_both_replicas_act_with_what_the_learner_hands_over(
    shared_ray: None, device: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    import torch

    sent: list[type] = []
    push = AppTarget._push

    def spied(target: AppTarget, values: Any, options: Any) -> int:
        sent.append(type(values))
        return push(target, values, options)

    monkeypatch.setattr(AppTarget, "_push", spied)
    if device == "cpu":
        monkeypatch.setattr(shared_values, "_MEMORY", SharedCpuMemory())
    caplog.set_level(logging.INFO, "vlagents_ray_learn")
    resources = {"num_gpus": 0.2} if device == "cuda" else {}
    document = deployment(
        "served_agents:OnOneGpu", config={"device": device}, replicas=2, resources=resources
    )
    learner = torch.nn.Linear(500, 400, device=device).requires_grad_(False)
    with shared_server(document) as server, Publisher("serve://OnOneGpu") as weights:

        def acted() -> set[tuple[int, float]]:
            return {first_act(server, "OnOneGpu", "http") for _ in range(4)}

        for version in (1, 2, 3):
            learner.weight.fill_(version)
            assert weights.push(learner.state_dict()) == version
            learner.weight.fill_(-1)  # a step of the optimizer
            assert weights.acknowledged(version) == 2
            assert acted() == {(version, version)}
        learner.weight.fill_(torch.nan)
        with pytest.raises(InvalidWeights, match="'weight': expected finite values, got NaN"):
            weights.push(learner.state_dict())
        assert set(sent) == {SharedValues}
        if device == "cpu":
            monkeypatch.setattr(shared_values, "_MEMORY", SharedCpuMemory("GPU-another"))
            learner.weight.fill_(4)
            assert weights.push(learner.state_dict()) == 4
            assert acted() == {(4, 4)}
            assert sent[-2:] == [SharedValues, list]
            assert (
                "the weights are sent through Ray's object store: replica SERVE_REPLICA"
                in caplog.text
            )
