"""Record the session that index.html replays: `python docs/demo/record.py` runs the reference
policy, and writes session.js.

The policy is served, and called over a WebSocket, as by a robot. Each call returns a chunk of
eight rows, of which four are executed. The states are those of the simulator, in its base frame
(`vlagents_ray.envs.tabletop`).
"""

from __future__ import annotations

import json
import os
from importlib.metadata import version
from pathlib import Path
from typing import Any

import typer

from vlagents_ray import Act, Agent, RemoteAgent
from vlagents_ray.envs.tabletop import Tabletop, render, world
from vlagents_ray.serve.launch.deployment_file import deployment
from vlagents_ray.serve.launch.server import running_server

FILE = Path(__file__).with_name("session.js")
CHECKPOINT = Path(__file__).parents[2] / "examples/reference/checkpoint"
POLICY = {"checkpoint": str(CHECKPOINT), "embodiment": "tabletop"}
# The seeds of each task. The policy fails with few seeds; these include three of them, so that the
# page also shows failures.
SEEDS = {"pick_place": range(12, 16), "slide": range(4), "stack": range(16, 20)}
EXECUTE = 4  # executed rows of each chunk
STAGES = ("decode_ms", "queue_ms", "inference_ms", "encode_ms", "wire_ms")
# The recording is a script, since a page that was opened as a file may not read other files.
_HEAD = "const SESSION = "


def main() -> None:
    """Run all episodes through a server, and write the recording."""
    served = deployment("reference", config=POLICY)
    with (
        running_server(served, num_cpus=2) as server,
        RemoteAgent(server.url, transport="websocket") as agent,
    ):
        episodes = []
        for task, seeds in SEEDS.items():
            episodes += [play(agent, task, seed) for seed in seeds]
    rates = json.loads((CHECKPOINT / "rates.json").read_text())["tabletop"]
    recording = {"version": version("vlagents-ray"), "cores": os.cpu_count(), "stages": STAGES}
    recording |= {"geometry": geometry(), "palette": render.PALETTE}
    recording |= {
        "rates": {task: rates[f"tabletop/{task}"] for task in SEEDS},
        "episodes": episodes,
    }
    # Write one episode per line.
    lines = json.dumps(recording, separators=(",", ":")).replace('{"task"', '\n{"task"')
    FILE.write_text(f"{_HEAD}{lines};\n")


def play(agent: Agent, task: str, seed: int) -> dict[str, Any]:
    """Return one episode, which ends when the task is solved or the episode is truncated."""
    with Tabletop(task, cameras=("front", "wrist"), width=64, height=64) as env:
        obs, _ = env.reset(seed=seed)
        agent.reset(obs, env.instruction, seed=seed)
        scene = env._world  # no observation contains the complete state of the scene
        states, acts, over, info = [state(scene)], [], False, {"success": False}
        while not over:
            act = agent.act(obs)
            timing = act.info.get("timing", {})
            total, *stages = [
                round(timing.get(stage, 0.0), 3) for stage in ("round_trip_ms", *STAGES)
            ]
            # Keep all digits of float32, so that the same actions produce the same states when they
            # are replayed.
            rows = [[float(f"{number:.9g}") for number in row] for row in act.rows()]
            acts.append(
                {"step": len(states) - 1, "round_trip_ms": total, "ms": stages, "rows": rows}
            )
            for row in act.rows()[:EXECUTE]:
                obs, _, _, truncated, info = env.step(Act(row))
                states.append(state(scene))
                if over := truncated or info["success"]:
                    break
        typer.echo(
            f"{task}, seed {seed}: {env.instruction!r}, {len(states) - 1} steps, solved: "
            f"{info['success']}"
        )
        return {
            "task": task,
            "seed": seed,
            "instruction": env.instruction,
            "solved": info["success"],
            "pads": [[pad.colour, _rounded(pad.x), _rounded(pad.y)] for pad in scene.pads],
            "pucks": [puck.colour for puck in scene.pucks],
            "states": states,
            "acts": acts,
        }


def state(scene: world.TabletopWorld) -> list[float]:
    """Return x, y and z of the fingertips and the gap in m, the index of the held puck or -1, and
    x, y and z of each puck in m.
    """
    held = next((i for i, puck in enumerate(scene.pucks) if puck is scene.held_puck), -1)
    pucks = [place for puck in scene.pucks for place in (puck.x, puck.y, puck.z)]
    return [
        held if i == 4 else _rounded(one)
        for i, one in enumerate((scene.x, scene.y, scene.z, scene.gap, 0, *pucks))
    ]


def geometry() -> dict[str, Any]:
    """Return the sizes with which the page draws the scene, in m and rad, and the control rate in
    Hz.
    """
    with Tabletop() as env:
        hz = env.contract.control_hz
    return {
        "view": render.VIEW,
        "elevation": round(render.ELEVATION, 6),
        "puck": [world.PUCK_RADIUS, world.PUCK_HEIGHT],
        "pad": world.PAD_HALF,
        "finger": world.FINGER_RADIUS,
        "reach": world.REACH,
        "limit": world.STEP_LIMIT,
        "execute": EXECUTE,
        "hz": hz,
    }


def recorded() -> dict[str, Any]:
    """Return the recording in session.js."""
    read: dict[str, Any] = json.loads(FILE.read_text().removeprefix(_HEAD).rstrip(";\n"))
    return read


def _rounded(metres: float) -> float:
    return round(metres, 4)


if __name__ == "__main__":
    main()
