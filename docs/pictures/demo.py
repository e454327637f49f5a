"""The moving picture of the README: `python docs/pictures/demo.py` plays the reference policy, and writes demo.gif.

The policy sees the pictures of 64 px it was trained with; the same actions are applied to a second environment with the
same seed, whose larger pictures are shown.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import typer
from PIL import Image

from vlagents_ray import Act
from vlagents_ray.envs import make_env
from vlagents_ray.policies.reference import Reference

FOLDER = Path(__file__).parent
SIDE, EVERY, FRAME_MS, PAUSE = 200, 2, 60, 12  # px; of the steps; ms; frames for which the end is shown
EPISODES = {"pick_place": 3, "slide": 3, "stack": 3, "lift": 3}  # task: seed


def played(agent: Reference, task: str, seed: int) -> list[np.ndarray]:
    """Return the front camera's pictures of an episode, (SIDE, SIDE, 3) uint8, until it is solved or over."""
    shown, frames = make_env(f"tabletop/{task}", width=SIDE, height=SIDE), []
    with make_env(f"tabletop/{task}", cameras=["front", "wrist"], width=64, height=64) as env, shown:
        obs, _ = env.reset(seed=seed)
        frames.append(shown.reset(seed=seed)[0].cameras["front"])
        agent.reset(obs, env.instruction, seed=seed)
        over = False
        while not over:
            for row in np.atleast_2d(agent.act(obs).action):
                obs, _, terminated, truncated, info = env.step(Act(row))
                frames.append(shown.step(Act(row))[0].cameras["front"])
                if over := terminated or truncated or info["success"]:
                    break
        typer.echo(f"{task}, seed {seed}: {env.instruction!r}, {len(frames)} steps, solved: {info['success']}")
    return frames[::EVERY] + [frames[-1]] * PAUSE


def main() -> None:
    """Play the episodes, and write them side by side."""
    agent = Reference.from_config({"checkpoint": "reference/checkpoint", "embodiment": "tabletop", "execute": 4})
    agent.initialize()
    clips = [played(agent, task, seed) for task, seed in EPISODES.items()]
    length = max(map(len, clips))
    clips = [clip + [clip[-1]] * (length - len(clip)) for clip in clips]
    pictures = [Image.fromarray(np.concatenate(row, 1)) for row in zip(*clips, strict=True)]
    palette = pictures[0].quantize(64)
    first, *rest = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    first.save(FOLDER / "demo.gif", save_all=True, append_images=rest, duration=FRAME_MS, loop=0, optimize=True)


if __name__ == "__main__":
    main()
