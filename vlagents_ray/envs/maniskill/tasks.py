"""ManiSkill's tasks in words, which it states for the Bridge tasks only."""

from __future__ import annotations

import re

# The tasks whose assets come with the package.
INSTRUCTIONS: dict[str, str] = {
    "LiftPegUpright-v1": "lift the peg and stand it upright on the table",
    "PegInsertionSide-v1": "pick up the peg and insert its orange end into the hole in the box",
    "PickCube-v1": "pick up the red cube and move it to the goal",
    "PlugCharger-v1": "pick up the charger and plug it into the receptacle",
    "PokeCube-v1": "poke the cube with the peg and push it onto the red and white target",
    "PullCube-v1": "pull the cube onto the red and white target",
    "PullCubeTool-v1": "pick up the L-shaped tool and pull the cube towards the robot with it",
    "PushCube-v1": "push the cube onto the red and white target",
    "PushT-v1": "push the T-shaped block onto the T-shaped target",
    "RollBall-v1": "roll the ball onto the red and white target",
    "StackCube-v1": "pick up the red cube and stack it on the green cube",
}


def instruction_for(task: str) -> str:
    """The task's instruction; for a task not in `INSTRUCTIONS` its name in words.

    "PickSingleYCB-v1" becomes "pick single ycb".
    """
    if task in INSTRUCTIONS:
        return INSTRUCTIONS[task]
    words = re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+", re.sub(r"-v\d+$", "", task))
    return " ".join(words).lower()
