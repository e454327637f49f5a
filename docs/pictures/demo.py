"""The moving picture of the README: `python docs/pictures/demo.py` plays the reference policy, and
writes demo.gif.

The policy sees the pictures of 64 px it was trained with; the same actions are applied to a second
environment with the same seed, whose larger pictures are shown.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import typer
from PIL import Image, ImageDraw, ImageFont

from vlagents_ray import Act
from vlagents_ray.envs import make_env
from vlagents_ray.policies.reference import Reference

FOLDER = Path(__file__).parent
# px; px of the instruction; ms; frames for which the end is shown.
SIDE, LINE, FRAME_MS, PAUSE = 200, 22, 80, 15
EPISODES = {"pick_place": 3, "slide": 5, "stack": 7, "lift": 11}  # task: seed


def played(agent: Reference, task: str, seed: int) -> list[Image.Image]:
    """Return the front camera's pictures of an episode until it is solved or over, above its
    instruction.
    """
    shown, frames = make_env(f"tabletop/{task}", width=SIDE, height=SIDE), []
    with (
        make_env(f"tabletop/{task}", cameras=["front", "wrist"], width=64, height=64) as env,
        shown,
    ):
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
        words = env.instruction
        typer.echo(
            f"{task}, seed {seed}: {words!r}, {len(frames)} steps, solved: {info['success']}"
        )
    return [with_words(frame, words) for frame in frames + [frames[-1]] * PAUSE]


def with_words(frame: np.ndarray, words: str) -> Image.Image:
    """Return a picture (SIDE, SIDE, 3) uint8 above words."""
    picture = Image.new("RGB", (SIDE, SIDE + LINE), "#37393d")
    picture.paste(Image.fromarray(frame))
    ImageDraw.Draw(picture).text(
        (SIDE / 2, SIDE + LINE / 2), words, "white", ImageFont.load_default(9), "mm"
    )
    return picture


def main() -> None:
    """Play the episodes, and write them side by side."""
    agent = Reference.from_config(
        {"checkpoint": "examples/reference/checkpoint", "embodiment": "tabletop", "execute": 4}
    )
    agent.initialize()
    clips = [played(agent, task, seed) for task, seed in EPISODES.items()]
    length = max(map(len, clips))
    clips = [clip + [clip[-1]] * (length - len(clip)) for clip in clips]
    pictures = [Image.fromarray(np.concatenate(row, 1)) for row in zip(*clips, strict=True)]
    palette = Image.fromarray(np.concatenate(pictures[::8])).quantize(
        128, Image.Quantize.MAXCOVERAGE, kmeans=3
    )
    first, *rest = [
        picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures
    ]
    first.save(
        FOLDER / "demo.gif",
        save_all=True,
        append_images=rest,
        duration=FRAME_MS,
        loop=0,
        optimize=True,
    )


if __name__ == "__main__":
    main()
