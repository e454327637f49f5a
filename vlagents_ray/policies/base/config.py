"""The settings that all model families share.

Each family adds settings and restricts the values of these.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, ClassVar, Literal

from pydantic import BaseModel, Field, field_validator, model_validator
from typing_extensions import Self

from vlagents_ray.policies.base.checkpoint import STEP
from vlagents_ray.policies.compilation import CompileMode, Quantization, uses_torch_compile

DType = Literal["auto", "float32", "bfloat16", "float16"]
Matmul = Literal["high", "highest"]
NoiseLevel = Annotated[
    float,
    Field(
        ge=0,
        description="randomness of the flow's steps in calls whose log-probability a learner "
        "requests, usually 0.5; 0: none is offered",
    ),
]

Guidance = Annotated[
    float, Field(gt=0, description="real-time chunking: largest gain of the guidance to the plan")
]


class ModelConfig(BaseModel, extra="forbid"):
    """The settings of a model: its checkpoint, its device, its inputs, and how its chunks become
    actions.
    """

    # Whether a policy of these settings replaces `{step}` itself. `find_checkpoint` also looks for
    # the step with leading zeros, as in LeRobot's folders.
    replaces_step: ClassVar[bool] = True

    checkpoint: str = Field(
        min_length=1,
        description="Folder, file or hub id (org/name, org/name@COMMIT). `{step}` stands for "
        "`checkpoint_step`.",
    )
    checkpoint_step: int | None = Field(
        default=None, ge=0, description="Training step that replaces `{step}`."
    )
    device: str = Field(
        default="auto",
        description="Device: `cpu`, `cuda`, `cuda:1`, or `auto`, an accelerator if there is one.",
    )
    dtype: DType = Field(
        default="auto", description="Dtype of the weights. `auto`: the default of the family."
    )
    matmul: Matmul = Field(
        default="high",
        description="Precision of float32 matrix products on a GPU. `high`: TF32, which keeps 10 "
        "bits of the inputs. `highest`: float32, several times slower. It applies to the whole "
        "process, in which the last policy to load decides.",
    )
    quantization: Quantization | None = Field(
        default=None,
        description="Keep the weights of linear layers in 8 bits (torchao), which takes a quarter "
        "to a half of their memory. It changes the actions, so compare them before use. "
        "`float8_dynamic` also computes their products in 8 bits, which needs `compile` true, max "
        "or require.",
    )
    compile: CompileMode = Field(
        default="auto",
        description=(
            "`graphs`: CUDA graphs of the forward pass for each of `batch_sizes`. `true`: on a GPU "
            "also graphs of the torch.compile'd forward pass, if they are faster, and on a CPU "
            "torch.compile alone. A part that cannot be compiled, or whose results differ, runs "
            "uncompiled. `max`: like true, but torch measures several kernels for each product, so "
            "that loading takes longer. `require`: like true, but such a part is an error. `auto`: "
            "`graphs` on a GPU, and false on a CPU or if the family has no graphs."
        ),
    )
    seed: int = Field(
        default=0, ge=0, description="Number that is mixed with the seed of each episode."
    )

    cameras: dict[str, str] | None = Field(
        default=None,
        description="Camera of the observation for each camera name of the model. null: the "
        "convention of the family.",
    )
    state: list[str] | None = Field(
        default=None,
        description=(
            "Parts of the observation's state that form the model's state vector, in its order. "
            "`gripper` means `Obs.gripper`, and `gripper_closed` means 1 - `Obs.gripper`. null: "
            "the convention of the family."
        ),
    )

    actions: Literal["chunk", "queue", "ensemble"] = Field(
        default="chunk",
        description=(
            "Result of a call. `chunk`: the whole chunk. `queue`: the next row of a chunk that the "
            "policy keeps, so that the model runs every `execute` calls. `ensemble`: one row, the "
            "average of the chunks of the model, which runs at each call."
        ),
    )
    execute: int | None = Field(
        default=None, ge=1, description="Number of rows of each chunk that are used. null: all."
    )
    ensemble_m: float = Field(
        default=0.01,
        description="The m in the weights exp(-m * i) of the average, oldest first (ACT, arXiv "
        "2304.13705).",
    )

    max_rows: int = Field(
        default=64,
        ge=1,
        description="Largest number of rows in one forward pass. Samples count as rows.",
    )
    batch_sizes: list[int] | None = Field(
        default=None,
        description=(
            "The only batch sizes to run, ascending. Each is run, or compiled, when the model is "
            "loaded, and smaller batches are padded. null: the sizes of the deployment's `batch` "
            "if the model is compiled, otherwise any."
        ),
    )

    @model_validator(mode="after")
    def _step_has_a_place(self) -> Self:
        if (STEP in self.checkpoint) != (self.checkpoint_step is not None):
            raise ValueError(
                f"checkpoint {self.checkpoint!r} and checkpoint_step {self.checkpoint_step}: "
                f"expected either both {STEP} in the checkpoint and a step, or neither; add or "
                "remove one"
            )
        return self

    @model_validator(mode="after")
    def _chunks_of_an_ensemble_overlap(self) -> Self:
        if self.actions == "ensemble" and self.execute == 1:
            raise ValueError(
                "execute: expected 2 or more with actions 'ensemble', got 1, which leaves "
                "nothing to average; leave it out"
            )
        return self

    @model_validator(mode="after")
    def _products_in_8_bits_are_compiled(self) -> Self:
        if self.quantization == "float8_dynamic" and not uses_torch_compile(self.compile):
            raise ValueError(
                f"quantization float8_dynamic: expected compile true, max or require, got "
                f"{self.compile!r}, with which each scale of each row would be a kernel; set "
                "compile: true"
            )
        return self

    @field_validator("batch_sizes")
    @classmethod
    def _ascending(cls, sizes: list[int] | None) -> list[int] | None:
        if sizes is not None and (not sizes or sizes[0] < 1 or sizes != sorted(set(sizes))):
            raise ValueError(
                f"expected ascending positive numbers, such as [1, 2, 4, 8, 16], got {sizes}"
            )
        return sizes

    def compile_on(self, device: str) -> CompileMode:
        """Return the setting `compile` for a kind of device, such as "cuda"; "auto" is resolved."""
        graphs: CompileMode = "graphs" if device == "cuda" else False
        return graphs if self.compile == "auto" else self.compile

    def with_sizes(self, sizes: Sequence[int]) -> Self:
        """Return the settings with these `batch_sizes`, unless they name others."""
        if self.batch_sizes is not None:
            return self
        return self.model_copy(update={"batch_sizes": list(sizes)})

    @property
    def rows(self) -> int:
        """The largest number of rows in one forward pass."""
        return self.batch_sizes[-1] if self.batch_sizes else self.max_rows


class AdapterConfig(ModelConfig):
    """Settings of a family that accepts a LoRA adapter, in addition to the settings of all models.
    Its policy sets `ModelPolicy.network`.
    """

    adapter: str | None = Field(
        default=None,
        min_length=1,
        description="LoRA adapter of the checkpoint that is merged into its weights: a folder of "
        "PEFT, or a hub id (org/name, org/name@COMMIT). null: none.",
    )
