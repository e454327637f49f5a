"""The change in docs that turns workers of Anyscale's template `groot-ray-serve` into clients of
this server.
"""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from asgi_server import policy_server
from readme_blocks import blocks

from vlagents_ray import Act, Agent, Obs

PAGE = Path(__file__).parents[2] / "docs" / "clients" / "gr00t.md"
INSTRUCTION = "pick up the apple and place it on the plate"
WIDTHS = {  # widths of the action's parts, as documented in the template's `policy_server.py`
    "left_wrist_eef_9d": 9,
    "right_wrist_eef_9d": 9,
    "left_hand": 7,
    "right_hand": 7,
    "left_arm": 7,
    "right_arm": 7,
    "waist": 3,
    "base_height_command": 1,
    "navigate_command": 3,
}
ROWS = 40


class Humanoid(Agent):
    """A policy whose numbers differ in all columns and calls, and that stores its observations."""

    # Instructions of all sessions, each of which has a copy of the policy.
    instructions: ClassVar[list[str | None]] = []
    observations: ClassVar[list[Obs]] = []

    def reset(self, obs: Obs, instruction: str | None, **kwargs: object) -> dict[str, object]:
        self.instructions.append(instruction)
        self.calls = 0
        return {}

    def act(self, obs: Obs) -> Act:
        self.observations.append(obs)
        self.calls += 1
        dim = sum(WIDTHS.values())
        rows = np.arange(ROWS * dim, dtype=np.float32).reshape(ROWS, dim)
        return Act(rows + 10_000 * self.calls)


def observation(pixel: int) -> dict[str, Any]:
    """Return an observation of the template's `G1LocomanipulationEnv`."""
    frames = np.full((1, 2, 48, 64, 3), pixel, np.uint8)
    state = {
        name: np.full((1, 1, width), pixel + number, np.float32)
        for number, (name, width) in enumerate(list(WIDTHS.items())[:7])
    }
    return {
        "video": {"ego_view": frames},
        "state": state,
        "language": {"annotation.human.task_description": [[INSTRUCTION]]},
    }


@pytest.fixture
def worker(tmp_path: Path) -> dict[str, Any]:
    """Return the names that the page's block defines, in a module with numpy, like
    `sim_worker.py`.
    """
    [block] = [block for block in blocks(PAGE.read_text()) if "def query_policy" in block.source]
    module = tmp_path / "sim_worker.py"
    module.write_text(f"import numpy as np\n{block.source}\n")
    return runpy.run_path(str(module))


def test_its_workers_execute_the_policys_actions_group_by_group(worker: dict[str, Any]) -> None:
    Humanoid.instructions.clear()
    Humanoid.observations.clear()
    with policy_server(Humanoid()) as port:
        url = f"http://127.0.0.1:{port}"
        for episode in (1, 2):
            worker["begin_episode"](url, observation(0))
            for call in (1, 2):
                pixel = 10 * episode + call
                response = worker["query_policy"](url, observation(pixel), timeout=120.0)

                action = response["action"]
                assert {name: rows.shape for name, rows in action.items()} == {
                    name: (1, ROWS, width) for name, width in WIDTHS.items()
                }
                joined = np.concatenate(list(action.values()), axis=2)[0]
                first = 10_000 * call
                np.testing.assert_array_equal(joined.ravel(), first + np.arange(joined.size))

                obs = Humanoid.observations[-1]
                expected = observation(pixel)
                np.testing.assert_array_equal(
                    obs.cameras["ego_view"], expected["video"]["ego_view"][0, -1]
                )
                assert obs.state.keys() == expected["state"].keys()
                for name, rows in expected["state"].items():
                    np.testing.assert_array_equal(obs.state[name], rows[0, 0])
        worker["connect"](url).close()
    assert Humanoid.instructions == [INSTRUCTION, INSTRUCTION]
