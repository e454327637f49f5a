"""The help of `vlagents-ray` in the light install of a robot's computer, which lacks Typer.

Without Typer, the other commands cannot be imported, so their names are here.
"""

from __future__ import annotations

from vlagents_ray.cli.help_page import HELP, VERSION, HelpPage, HelpPanel, HelpRow
from vlagents_ray.registry import names, pip_install

ROBOT = "Drive a robot or simulation with a policy, an operator, or both."
# The core's other commands, by the extra that they need.
OTHERS = {
    "sim": ("eval", "demo", "replay"),
    "serve": ("serve", "doctor", "report", "export", "policies", "envs", "venv", "keys", "init"),
}


def help_page() -> HelpPage:
    """Return the help: the commands of the light install, and what the others need."""
    of_plugins = [name for name in names("commands") if "." not in name]
    rows = []
    for extra, commands in OTHERS.items():
        all_names = [*commands, *of_plugins] if extra == "serve" else commands
        rows.append(HelpRow(", ".join(all_names), f"Run {pip_install(extra)} for these commands."))
    return HelpPage(
        "vlagents-ray [OPTIONS] COMMAND ...",
        "This is the light install of a robot's computer, without Ray and the server.",
        (
            HelpPanel("Commands", (HelpRow("robot", ROBOT),)),
            HelpPanel("Commands that are not installed", tuple(rows)),
            HelpPanel("Options", (HelpRow("--version", VERSION), HelpRow("-h, --help", HELP))),
        ),
        ("vlagents-ray robot http://gpu-box:8000 --robot my_arm:MyArm",),
    )
