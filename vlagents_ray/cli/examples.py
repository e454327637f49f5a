"""Example command lines, shown at the end of each command's help."""

from __future__ import annotations

from collections.abc import Iterable

PROMPT = "$ "
# Command -> example command lines, without "vlagents-ray". Examples of plug-ins are in their
# registry entries.
EXAMPLES: dict[str, tuple[str, ...]] = {
    "serve": (
        "serve scripted",
        "serve deployments/lerobot.yaml --set checkpoint=runs/act/last",
        "serve noop --host 0.0.0.0 --keys keys.json",
    ),
    "eval": (
        "eval tabletop --policy scripted --episodes 20",
        "eval examples/evaluations/tabletop.yaml --set suites.0.episodes=5 --out runs/short",
        "eval runs.yaml --resume --live",
    ),
    "robot": (
        "robot http://gpu-box:8000 --robot my_arm:MyArm --seconds 60 --record demos",
        "robot scripted --env tabletop --episodes 3 --rerun live",
        "robot --env tabletop --teleop keyboard --record demos",
    ),
    "demo": ("demo", "demo --out runs/second"),
    "doctor": ("doctor", "doctor --python .venv-lerobot/bin/python --json"),
    "report": ("report runs/first", "report runs/act runs/pi0 --out comparison.html"),
    "export": (
        "export runs/first --to csv --out episodes.csv",
        "export runs/first --to lerobot --out dataset --set successes=true",
    ),
    "replay": ("replay runs/first 'tabletop#3'", "replay runs/first 'tabletop#3' --policy noop"),
    "policies": ("policies", "policies lerobot"),
    "envs": ("envs", "envs libero --json"),
    "venv create": (
        "venv create lerobot",
        "venv create needs.txt --out .venv-mine --python 3.12 --light",
    ),
    "keys create": (
        "keys create arm-1 --keys keys.json",
        "keys create learner --keys keys.json --scope weights --days 30",
    ),
    "keys list": ("keys list", "keys list --keys /etc/vlagents-ray/keys.json"),
    "keys revoke": (
        "keys revoke arm-1",
        "keys revoke arm-1 --keys /etc/vlagents-ray/keys.json",
    ),
    "init policy": ("init policy my_policy",),
    "init env": ("init env my_env",),
    "init dialect": ("init dialect my_dialect",),
    "init plugin": ("init plugin my_plugin",),
}


def epilog(examples: Iterable[str]) -> str:
    """Return the end of the help of a command.

    Args:
        examples: Command lines without "vlagents-ray".
    """
    lines = [f"{PROMPT}vlagents-ray {example}" for example in examples]
    # Typer joins lines that no empty line separates.
    return "\n\n".join(["Examples:", *lines])
