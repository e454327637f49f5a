"""The minimal client that users copy: it imports nothing of this package, and works with a real
server.
"""

from __future__ import annotations

import ast
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import minimal_client
import numpy as np
import pytest
from asgi_server import policy_server
from minimal_client import Policy, PolicyError

from vlagents_ray import Act, Agent, Obs

SLOW_S = 1.5
IMAGE = np.random.default_rng(0).integers(0, 256, (48, 64, 3), np.uint8)


class Seeing(Agent):
    """A policy that returns the means of its images. A joint above 1 raises an error, and a joint
    below -1 takes `SLOW_S`.
    """

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        return {"instruction": instruction, "seed": kwargs.get("seed"), "worst": float("nan")}

    def act(self, obs: Obs) -> Act:
        joint = float(obs.state["joints"][0])
        if joint > 1:
            raise RuntimeError("the arm is at another position")
        if joint < -1:
            time.sleep(SLOW_S)
        seen = [float(image.mean()) for image in obs.cameras.values()]
        row = np.array([joint, obs.gripper or 0.0, *seen], np.float32)
        return Act(
            np.stack([row, row]), done=True, info={"cameras": [*obs.cameras], "raw": b"\x01\x02"}
        )


@pytest.fixture(scope="module")
def url() -> Iterator[str]:
    with policy_server(Seeing()) as port:
        yield f"ws://127.0.0.1:{port}/v1/stream"


def joints(first: float) -> dict[str, np.ndarray]:
    return {"joints": np.array([first, 0.5], np.float32)}


def test_it_stands_alone() -> None:
    text = Path(minimal_client.__file__).read_text()
    nodes = [
        node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Import | ast.ImportFrom)
    ]
    names = {alias.name for node in nodes for alias in node.names if isinstance(node, ast.Import)}
    names |= {str(node.module) for node in nodes if isinstance(node, ast.ImportFrom)}
    assert not [name for name in names if name.startswith("vlagents_ray")]


@pytest.mark.parametrize("jpeg", [None, 85])
def test_images_numbers_and_the_task_arrive_and_the_action_comes_back(
    url: str, jpeg: int | None
) -> None:
    with Policy(url, jpeg=jpeg) as policy:
        info = policy.reset(
            {"front": IMAGE}, joints(0.25), 1.0, instruction="stack", kwargs={"seed": 3}
        )
        assert (info["instruction"], info["seed"]) == ("stack", 3)
        assert np.isnan(info["worst"])
        answer = policy.act({"front": IMAGE, "wrist": IMAGE[::2, ::2, ::-1]}, joints(0.25), 0.5)
    assert answer["action"].dtype == np.float32
    assert answer["action"].shape == (2, 4)
    np.testing.assert_allclose(
        answer["action"][1], [0.25, 0.5, IMAGE.mean(), IMAGE[::2, ::2].mean()], atol=1
    )
    assert answer["done"] is True
    assert (answer["info"]["cameras"], answer["info"]["raw"]) == (["front", "wrist"], b"\x01\x02")


def test_an_error_has_its_code_and_text_and_the_session_goes_on(url: str) -> None:
    with Policy(url) as policy:
        with pytest.raises(PolicyError) as refused:
            policy.act({}, joints(0))
        assert refused.value.args[0] in ("not_reset", "unknown_session")
        policy.reset({}, joints(0))
        with pytest.raises(PolicyError, match="RuntimeError") as failed:
            policy.act({}, joints(2))
        assert failed.value.args[0] == "policy_failed"
        assert policy.act({}, joints(0))["action"].shape == (2, 2)


@pytest.mark.slow
def test_a_deadline_ends_the_wait_and_a_late_answer_is_not_taken_for_another(url: str) -> None:
    with Policy(url, timeout_s=SLOW_S / 2) as policy:
        policy.reset({}, joints(0))
        begun = time.monotonic()
        with pytest.raises((PolicyError, TimeoutError)) as late:
            policy.act({}, joints(-2))
        assert time.monotonic() - begun < SLOW_S
        assert isinstance(late.value, TimeoutError) or late.value.args[0] == "outcome_unknown"
        time.sleep(SLOW_S)
        assert policy.act({}, joints(0.75))["action"][0, 0] == 0.75
