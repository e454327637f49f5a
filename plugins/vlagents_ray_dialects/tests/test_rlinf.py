"""Tests of the adapter with which RLinf's rollout worker is a client of this server."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from dialect_server import image, serving
from served_agents import Mirror

from vlagents_ray_dialects.messages import openpi
from vlagents_ray_dialects.rlinf import PolicyServerAdapter

torch = pytest.importorskip("torch")

CONFIG: Any = SimpleNamespace(
    rollout=SimpleNamespace(model=SimpleNamespace(num_action_chunks=2)),
)


def observed(pixels: list[int], *, begins: bool) -> dict[str, Any]:
    """Return the observations that RLinf's worker passes to an adapter: tensors with a row for each
    environment, and the worker's own keys.
    """
    states = np.tile(np.float32([0, 0, 0, 0, 0, 1, 0.04, -0.04]), (len(pixels), 1))
    return {
        "main_images": torch.from_numpy(np.stack([image(pixel) for pixel in pixels])),
        "wrist_images": None,
        "states": torch.from_numpy(states),
        "task_descriptions": [f"task {index + 1}" for index in range(len(pixels))],
        "_rlinf_stage_id": 1,
        "_rlinf_reset": begins,
    }


def test_each_environment_is_a_session_and_gets_the_rows_that_are_executed() -> None:
    dialects = {"sglang": {"mapping": "rlinf-libero"}}
    with serving(Mirror(chunk=3), dialects) as (client, engine):
        adapter = PolicyServerAdapter(CONFIG, rank=2)

        def predict(pixels: list[int], *, begins: bool = False) -> Any:
            request, state = adapter.build_request(observed(pixels, begins=begins))
            response = client.post(
                adapter.action_path,
                content=openpi.encode(request),
                headers={"content-type": "application/msgpack"},
            )
            assert response.status_code == 200, response.text
            return adapter.parse_response(openpi.decode(response.content), state)[0]

        for acts in (1, 2):
            actions = predict([7, 8])
            assert actions.dtype == torch.float32
            assert actions.shape == (2, 2, 7)
            # A row contains a pixel, the sum of the state, the session's number of acts, and the
            # number of its instruction.
            assert actions[:, 0, :4].tolist() == [[7, 1, acts, 1], [8, 1, acts, 2]]
            # The gripper is open, which is -1 in LIBERO's convention.
            assert actions[:, 0, 6].tolist() == [-1, -1]
        assert len(engine.sessions) == 2

        assert predict([7, 8], begins=True)[:, 0, 2].tolist() == [1, 1]

        # Another run has new sessions.
        adapter = PolicyServerAdapter(CONFIG, rank=2)
        assert predict([7, 8])[:, 0, 2].tolist() == [1, 1]
        assert len(engine.sessions) == 4


def test_it_evaluates_only() -> None:
    with pytest.raises(NotImplementedError, match="expected 'eval', got 'train'"):
        PolicyServerAdapter(CONFIG, 0).build_request({}, mode="train")
