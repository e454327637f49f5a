"""A robot with the real client of vlagents. The Python of the peers' environment runs it, and it
imports nothing of this package.

`vlagents_robot.py HOST PORT MODEL MODE`, MODE "raw", "jpeg" or "shm". For each line of standard
input, a JSON object, it prints a JSON object: {"pixel", "joints", "gripper", "instruction",
"robots"?, "calls"?, "kwargs"?}, or {"say": "name" | "git_status" | "is_initialized" | "segments" |
"close"}.
"""

from __future__ import annotations

import json
import os
import sys

import numpy as np
import vlagents.client

try:
    from vlagents.policies.interface import Obs, SingleObs
except ImportError:  # vlagents 0.2
    from vlagents.policies import Obs

    SingleObs = None  # type: ignore[assignment,misc]


def image(wish: dict) -> np.ndarray:
    return np.full((224, 224, 3), wish["pixel"], np.uint8)


def observation(wish: dict) -> Obs:
    joints = np.full(7, wish["joints"], np.float32)
    if SingleObs is None:
        return Obs(cameras={"front": image(wish)}, gripper=wish["gripper"], state=joints)
    one = {
        name: SingleObs(cameras={"front": image(wish)}, gripper=wish["gripper"], joints=joints)
        for name in wish.get("robots", ["arm"])
    }
    return Obs(obs=one, language_instruction=wish["instruction"])


def plain(act: object) -> list:
    """Return [[robot, action, gripper, done, info]] for each step."""
    if SingleObs is None:
        return [["", act.action.tolist(), None, act.done, act.info]]
    return [
        [name, one.action.tolist(), one.gripper, one.done, one.info]
        for step in act.acts
        for name, one in step.items()
    ]


def main() -> None:
    host, port, model, mode = sys.argv[1:]
    out = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    agent = vlagents.client.RemoteAgent(
        host, int(port), model, on_same_machine=mode == "shm", jpeg_encoding=mode == "jpeg"
    )
    for line in sys.stdin:
        wish = json.loads(line)
        try:
            if wish.get("say") == "close":
                agent.close()
                answer = "closed"
            elif wish.get("say") == "segments":
                answer = [segment.name for segment in agent._shm.values()]
            elif "say" in wish:
                answer = getattr(agent, wish["say"])()
            elif "reset" in wish:
                answer = agent.reset(observation(wish), wish["reset"], **wish.get("kwargs", {}))
            else:
                answer = [plain(agent.act(observation(wish))) for _ in range(wish.get("calls", 1))]
        except Exception as error:  # noqa: BLE001 - sent to the test
            answer = {"error": str(error)}
        print(json.dumps(answer), file=out, flush=True)


if __name__ == "__main__":
    main()
