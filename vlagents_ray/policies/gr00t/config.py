"""Settings of GR00T."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from vlagents_ray.policies.base import ModelConfig


class Gr00tConfig(ModelConfig):
    """Settings of GR00T, beside those of all models."""

    checkpoint: str = Field(
        min_length=1,
        description="folder of GR00T's training, such as outputs/checkpoint-{step}, or hub id: org/name, "
        "org/name@COMMIT",
    )
    source_dir: str | None = Field(
        default=None, description="a checkout of Isaac-GR00T; unset: the variable GR00T_SRC, or what is installed"
    )
    embodiment: str | None = Field(
        default=None, description="the checkpoint's name of the robot, such as new_embodiment; unset: its only one"
    )
    backbone: str | None = Field(
        default=None,
        description="N1.7: folder of the vision-language model that the checkpoint names, nvidia/Cosmos-Reason2-2B, "
        "whose path must contain that name; unset: from the hub or its cache",
    )
    steps: int | None = Field(default=None, ge=1, description="steps of the flow; unset: the checkpoint's, usually 4")
    compile: Literal[False] = Field(default=False, description="not offered for GR00T")
    trust_remote_code: bool = Field(
        default=False,
        description="run Python code that lies in the checkpoint or its backbone: whoever can write there can do on "
        "this machine whatever this process can",
    )
