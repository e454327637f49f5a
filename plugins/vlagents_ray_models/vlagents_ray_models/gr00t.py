"""GR00T N1.6 and N1.7 with NVIDIA's own code, Isaac-GR00T."""

from __future__ import annotations

import contextlib
import importlib.util
import json
import os
import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from pydantic import Field

from vlagents_ray.contract import ActionSpec, Contract, Rotation, StateSpec
from vlagents_ray.errors import ConfigError
from vlagents_ray.interface import Obs
from vlagents_ray.policies.base import ModelConfig, ModelPolicy, Prediction, Row
from vlagents_ray.policies.base.accelerator import (
    ensure_torchvision,
    fetch,
    torch_device,
    torch_dtype,
)
from vlagents_ray.policies.base.checkpoint import SavedTensors, find_checkpoint, require_loaded
from vlagents_ray.policies.base.model_inputs import (
    GRIPPER,
    camera_images,
    choose_cameras,
    state_vector,
)
from vlagents_ray.policies.base.staging import Staging
from vlagents_ray.policies.compilation import Compilation
from vlagents_ray.policies.outcomes import attempt, compute_valid
from vlagents_ray.registry import require
from vlagents_ray_models.model_code import remote_code, use_source

CONFIG, STATISTICS = "processor_config.json", "statistics.json"
# Relative representation of actions -> whether decoded actions are deltas.
_RELATIVE = {"RELATIVE": False, "DELTA": True}
_SPACES = {"NON_EEF": "joint", "EEF": "ee_pose"}
_ROTATIONS: Mapping[str, Rotation] = {"XYZ_ROT6D": "rot6d", "XYZ_ROTVEC": "axis_angle"}
_POSITION = 3  # numbers of a position, which precede a rotation
_CURE = "save the checkpoint's processor with its dataset's statistics, as GR00T's training does"


@dataclass(frozen=True)
class Embodiment:
    """The inputs and the actions of one robot of a checkpoint."""

    # Name of the embodiment; GR00T's code reads it from this field, as from an `EmbodimentTag`.
    value: str
    cameras: tuple[str, ...]
    state: Mapping[str, int]  # groups and their widths, in the model's order
    action: Mapping[str, int]  # groups and their widths, like `state`
    # For "video" and "state", the offsets of the observations that are read; 0 is the newest.
    offsets: Mapping[str, tuple[int, ...]]
    horizon: int  # rows of a chunk
    spec: ActionSpec
    # Bounds of "state" and "action" in training, by group, in the robot's units.
    ranges: Mapping[str, Any]

    @property
    def history(self) -> int:
        """The number of consecutive observations that the model reads."""
        return 1 - min(min(offsets, default=0) for offsets in self.offsets.values())

    @classmethod
    def from_folder(cls, folder: Path, name: str | None) -> Embodiment:
        """Read an embodiment from the folder of a processor.

        Args:
            folder: The folder with the processor's configuration and its statistics.
            name: The name of the embodiment; None selects the only one with statistics.

        Raises:
            ConfigError: A file or a statistic is missing, or `name` does not identify one
                embodiment.
        """
        settings, statistics = _read_processor(folder)
        configs = settings["modality_configs"]
        name = _choose_embodiment(name, configs, statistics)
        config = configs[name]

        bound_names = ("q01", "q99") if settings.get("use_percentiles") else ("min", "max")
        ranges: dict[str, dict[str, dict[str, list[float]]]] = {}
        widths: dict[str, dict[str, int]] = {}
        for kind in ("state", "action"):
            ranges[kind], widths[kind] = {}, {}
            for group in config[kind]["modality_keys"]:
                bounds = _bounds(folder, statistics[name], kind, group, bound_names)
                ranges[kind][group] = bounds
                widths[kind][group] = len(bounds[bound_names[0]])

        action_spec = _action_spec(
            config["action"].get("action_configs") or (),
            list(widths["action"].values()),
            converts=bool(settings.get("use_relative_action")),
        )
        return cls(
            value=name,
            cameras=tuple(config["video"]["modality_keys"]),
            state=widths["state"],
            action=widths["action"],
            offsets={kind: tuple(config[kind]["delta_indices"]) for kind in ("video", "state")},
            horizon=len(config["action"]["delta_indices"]),
            spec=action_spec,
            ranges=ranges,
        )

    def require_fits(self, config: Any) -> None:
        """Raise `ConfigError` unless the model of `config` has room for the state, the actions
        and the chunk's rows.
        """
        sizes = (
            ("state", "numbers", sum(self.state.values()), config.max_state_dim),
            ("action", "numbers", sum(self.action.values()), config.max_action_dim),
            ("chunk", "rows", self.horizon, config.action_horizon),
        )
        for name, unit, size, largest in sizes:
            if size > largest:
                raise ConfigError(
                    f"embodiment {self.value!r}: its {name} has {size} {unit}, the model at most "
                    f"{largest}: is the processor that of another checkpoint?"
                )


def _read_processor(folder: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the settings of a processor and its statistics by embodiment."""
    try:
        settings = json.loads((folder / CONFIG).read_text(encoding="utf-8"))["processor_kwargs"]
        statistics = json.loads((folder / STATISTICS).read_text(encoding="utf-8"))
        settings["modality_configs"]  # raises KeyError if there are no statistics
    except FileNotFoundError as error:
        files = sorted(file.name for file in folder.iterdir())
        raise ConfigError(
            f"checkpoint {folder}: expected {Path(error.filename).name}, got {files}; {_CURE}"
        ) from error
    except (ValueError, KeyError, TypeError) as error:
        raise ConfigError(
            f"checkpoint {folder}: {CONFIG} and {STATISTICS} are not files of GR00T's "
            f"processor ({type(error).__name__}: {error}); {_CURE}"
        ) from error
    return settings, statistics


def _choose_embodiment(
    name: str | None, configs: Mapping[str, Any], statistics: Mapping[str, Any]
) -> str:
    """Return the name if the embodiment has statistics.

    With None, return the only embodiment with statistics.
    """
    usable = sorted(set(configs) & set(statistics))
    if name is None and len(usable) == 1:
        return usable[0]
    if name is None or name not in usable:
        unusable = sorted(set(configs) - set(statistics))
        hint = f"; {unusable} have no statistics in this checkpoint" if unusable else ""
        raise ConfigError(f"embodiment: expected one of {usable}, got {name!r}{hint}")
    return name


def _bounds(
    folder: Path,
    statistics: Mapping[str, Any],
    kind: str,
    group: str,
    bound_names: tuple[str, str],
) -> dict[str, list[float]]:
    """Return the bounds of a group under their names.

    Args:
        folder: The folder of the processor, for messages.
        statistics: The statistics of the embodiment.
        kind: "state" or "action".
        group: The name of the group.
        bound_names: The names of the lower and the upper bounds.

    Raises:
        ConfigError: A bound is missing or not finite.
    """
    of_kind = statistics.get(kind, {})
    lower, upper = (
        np.asarray(of_kind.get(group, {}).get(name, ()), np.float64) for name in bound_names
    )
    if lower.ndim != 1 or not lower.size or lower.shape != upper.shape:
        raise ConfigError(
            f"checkpoint {folder}: expected {list(bound_names)} of {kind} {group!r} in "
            f"{STATISTICS}, got those of {sorted(of_kind)}; without them its numbers have no "
            f"units: {_CURE}"
        )
    if not np.isfinite([lower, upper]).all():
        raise ConfigError(
            f"checkpoint {folder}: {list(bound_names)} of {kind} {group!r} are not all finite; "
            f"{_CURE}"
        )
    return dict(zip(bound_names, (lower.tolist(), upper.tolist()), strict=True))


def _action_spec(
    groups: Sequence[Mapping[str, Any]], widths: Sequence[int], *, converts: bool
) -> ActionSpec:
    """Describe the columns of the actions, if the checkpoint declares relative groups.

    A checkpoint without relative groups calls even displacements absolute, such as LIBERO's, so
    the contract does not describe its actions.

    Args:
        groups: The checkpoint's description of each group.
        widths: The number of values of each group.
        converts: Whether GR00T converts relative groups to absolute ones, which it does if the
            processor has `use_relative_action`.
    """
    undescribed = ActionSpec(dim=sum(widths))
    relative = [group for group in groups if converts and group["rep"] in _RELATIVE]
    if not relative or len(groups) != len(widths):
        return undescribed

    targets: list[int] = []
    rotation_columns: list[int] = []
    rotations: set[Rotation] = set()
    start = 0
    for group, width in zip(groups, widths, strict=True):
        if not _RELATIVE.get(group["rep"]):
            targets += range(start, start + width)
        rotation = _ROTATIONS.get(group["format"]) if group["type"] == "EEF" else None
        if rotation is not None:
            rotations.add(rotation)
            rotation_columns.append(start + _POSITION)
        start += width
    if len(rotations) > 1:  # an `ActionSpec` has one representation for all rotations
        return undescribed

    has_deltas = len(targets) < start
    spaces = {_SPACES.get(group["type"]) for group in relative}
    return replace(
        undescribed,
        delta=has_deltas,
        absolute=tuple(targets) if has_deltas and targets else None,
        space=spaces.pop() if len(spaces) == 1 else None,
        rotation=rotations.pop() if rotations else None,
        rotation_columns=tuple(rotation_columns) if rotation_columns else None,
    )


class Gr00tConfig(ModelConfig):
    """Settings of GR00T, in addition to the settings of all models."""

    checkpoint: str = Field(
        min_length=1,
        description="folder of GR00T's training, such as outputs/checkpoint-{step}, or hub id: "
        "org/name, org/name@COMMIT",
    )
    source_dir: str | None = Field(
        default=None,
        description="a checkout of Isaac-GR00T; unset: the one that the variable GR00T_SRC names, "
        "or the installed one",
    )
    embodiment: str | None = Field(
        default=None,
        description="the checkpoint's name of the robot, such as new_embodiment; unset: its only "
        "one",
    )
    backbone: str | None = Field(
        default=None,
        description="N1.7: folder of the vision-language model that the checkpoint names, "
        "nvidia/Cosmos-Reason2-2B, whose path must contain that name; unset: from the hub or its "
        "cache",
    )
    steps: int | None = Field(
        default=None, ge=1, description="steps of the flow; unset: the checkpoint's, usually 4"
    )
    spare_tokens: int = Field(
        default=32,
        ge=0,
        description="compiled: tokens that a prompt may have beyond two words; a longer one runs "
        "without compilation",
    )
    trust_remote_code: bool = Field(
        default=False,
        description="run Python code in the checkpoint or its backbone: write access to them then "
        "gives all rights of this process",
    )


SOURCE = "GR00T_SRC"
_MODEL = "config.json"


@dataclass(frozen=True)
class Gr00tInputs:
    """The inputs of one row."""

    processed: Any  # the result of the checkpoint's processor
    state: dict[str, np.ndarray]  # states (T, D) float32 by group, needed to decode the actions


@dataclass(frozen=True)
class Gr00tNetwork:
    """A loaded checkpoint, for one embodiment."""

    model: Any
    processor: Any
    embodiment: Embodiment
    # Only one thread at a time may use the processor, since its transforms store their parameters,
    # and it changes the warning filters of the whole process.
    reading: threading.Lock = field(default_factory=threading.Lock, repr=False, compare=False)

    @classmethod
    def load(cls, config: Gr00tConfig) -> Gr00tNetwork:
        """Read a checkpoint.

        Raises:
            ConfigError: A file or a weight is missing, or the checkpoint has another version or
                embodiment.
        """
        code = _use_checkout(config.source_dir)
        folder = find_checkpoint(
            config.checkpoint, config.checkpoint_step, needs=[_MODEL, "*.safetensors"]
        )
        _require_version(folder)
        processor_folder = _processor_folder(folder)
        embodiment = Embodiment.from_folder(processor_folder, config.embodiment)

        device = torch_device(config.device)
        dtype = torch_dtype(config.dtype, device)
        # flash-attention supports only 16-bit numbers on GPUs.
        uses_flash = (
            device.type == "cuda"
            and dtype.itemsize == 2
            and bool(require("transformers.utils").is_flash_attn_2_available())
        )
        transformers = require("transformers")
        options = {} if config.backbone is None else {"model_name": config.backbone}
        with (
            remote_code(allowed=config.trust_remote_code, source=code),
            contextlib.nullcontext() if uses_flash else built_without_flash_attention(),
        ):
            try:
                model = transformers.AutoModel.from_pretrained(folder, torch_dtype=dtype, **options)
                processor = transformers.AutoProcessor.from_pretrained(processor_folder, **options)
            except ConfigError:
                raise
            except (
                OSError,
                ValueError,
                KeyError,
                RuntimeError,
                AssertionError,
                TypeError,
            ) as error:
                raise ConfigError(
                    f"checkpoint {folder}: GR00T's code could not load it ({type(error).__name__}: "
                    f"{str(error).strip()[:500]}); is it complete, of this checkout's version, and "
                    "its backbone on the hub, in the cache, or in a folder that `backbone` names?"
                ) from error
        if not uses_flash:
            use_torch_attention(model)

        saved = SavedTensors.open(folder)
        model = _moved(model.eval().requires_grad_(False), saved, device, dtype)
        require_loaded(model, saved)
        embodiment.require_fits(model.config)
        if embodiment.value not in processor.embodiment_id_mapping:
            raise ConfigError(
                "embodiment: expected one in embodiment_id.json, "
                f"{sorted(processor.embodiment_id_mapping)}, got {embodiment.value!r}; save the "
                "checkpoint's processor with it"
            )

        if config.steps is not None:
            model.action_head.num_inference_timesteps = config.steps
        processor.eval()
        return cls(model, processor, embodiment)

    @cached_property
    def staging(self) -> Staging:
        """Copies the inputs of a batch to the model's device."""
        return Staging(self.model.device)

    @cached_property
    def masks_padding(self) -> bool:
        """Whether all layers above the language model mask padding, as N1.6's default transformer
        does.
        """
        layers = getattr(self.model.action_head, "vl_self_attention", None)
        has_none = layers is None or not list(layers.parameters())
        return has_none and bool(self.model.config.use_alternate_vl_dit)

    def read(
        self,
        images: Sequence[dict[str, np.ndarray]],
        states: Sequence[dict[str, np.ndarray]],
        instruction: str,
    ) -> Gr00tInputs:
        """Convert observations to the inputs of one row.

        Args:
            images: The images of each observation that the embodiment's video reads, oldest first:
                (H, W, 3) uint8 by camera.
            states: The state of each observation that its state reads: (D,) float32 by group.
            instruction: The task in words.

        Returns:
            The inputs, to be passed to `compute_chunks`.
        """
        types = require("gr00t.data.types")
        robot = self.embodiment
        videos: dict[str, list[np.ndarray]] = {}
        for camera in robot.cameras:
            videos[camera] = [by_camera[camera] for by_camera in images]
        state: dict[str, np.ndarray] = {}
        for group in robot.state:
            state[group] = np.stack([by_group[group] for by_group in states])

        step = types.VLAStepData(
            images=videos, states=state, actions={}, text=instruction, embodiment=robot
        )
        message = {"type": types.MessageType.EPISODE_STEP.value, "content": step}
        with self.reading:
            processed = self.processor([message])
        return Gr00tInputs(processed, state)

    def compute_chunks(
        self, rngs: Sequence[np.random.Generator], inputs: Sequence[Gr00tInputs]
    ) -> list[np.ndarray]:
        """Compute the chunks of rows in one forward pass.

        If the model does not mask padding, each prompt length needs a separate pass.

        Args:
            rngs: The generator of each row's noise.
            inputs: The result of `read` for each row.

        Returns:
            A chunk for each row, (horizon, D) float32, in the robot's units.
        """
        batch = self._collate(inputs)
        lengths = batch["inputs"]["attention_mask"].sum(1).tolist()
        if self.masks_padding or len(set(lengths)) == 1:
            return self._compute_pass(rngs, inputs, batch)

        chunks: dict[int, np.ndarray] = {}
        for length in sorted(set(lengths)):
            indices = [i for i, row_length in enumerate(lengths) if row_length == length]
            pass_rngs = [rngs[i] for i in indices]
            pass_inputs = [inputs[i] for i in indices]
            pass_chunks = self._compute_pass(pass_rngs, pass_inputs, self._collate(pass_inputs))
            chunks |= zip(indices, pass_chunks, strict=True)
        return [chunks[i] for i in range(len(inputs))]

    def _collate(self, inputs: Sequence[Gr00tInputs]) -> Any:
        return self.processor.collator([row.processed for row in inputs])

    def _compute_pass(
        self, rngs: Sequence[np.random.Generator], inputs: Sequence[Gr00tInputs], batch: Any
    ) -> list[np.ndarray]:
        """Compute the chunks of the rows whose inputs `batch` contains."""
        from vlagents_ray_models.sampling_rng import RowDraws

        # Otherwise, GR00T's own code would copy from pageable memory, and wait for the GPU.
        torch, pytree = require("torch"), require("torch.utils._pytree")
        uploaded = pytree.tree_map_only(torch.Tensor, self.staging.upload, dict(batch["inputs"]))
        with torch.inference_mode(), RowDraws(rngs, self.model.action_head):
            predicted = fetch(self.model.get_action(uploaded)["action_pred"].float())

        states: dict[str, np.ndarray] = {}
        for group in self.embodiment.state:
            states[group] = np.stack([row.state[group] for row in inputs])
        decoded = self.processor.decode_action(predicted, self.embodiment, states)
        groups = [decoded[group] for group in self.embodiment.action]
        return list(np.concatenate(groups, axis=-1).astype(np.float32))


def _processor_folder(folder: Path) -> Path:
    """Return the folder of a checkpoint's processor: the checkpoint's folder, or the subfolder in
    which N1.7's training saves the processor.
    """
    beneath = folder / "processor"
    return folder if (folder / CONFIG).is_file() or not beneath.is_dir() else beneath


def _use_checkout(source_dir: str | None) -> Path:
    """Make GR00T's code importable.

    Returns:
        The folder of its models, whose code transformers imports.

    Raises:
        ConfigError: The code is not found, or is the code of N1.5 or an earlier version.
    """
    use_source("gr00t", SOURCE, source_dir)
    if importlib.util.find_spec("gr00t.policy") is None:
        raise ConfigError(
            f"{source_dir or os.environ.get(SOURCE) or 'gr00t'}: expected GR00T's code of N1.6 or "
            "N1.7, got that of N1.5 or before; serve N1.5 by its own server, and the policy "
            "`upstream` in front of it"
        )
    # Otherwise, importing the package would query PyPI for a newer version.
    os.environ.setdefault("NO_ALBUMENTATIONS_UPDATE", "1")
    ensure_torchvision()
    return Path(str(require("gr00t.model").__file__)).parent


def _moved(model: Any, saved: SavedTensors, device: Any, dtype: Any) -> Any:
    """Move a model to a device and a dtype.

    GR00T's code reads N1.6's backbone in bfloat16, which rounds the backbone's weights. If the
    model computes in another type, the weights are copied from the checkpoint again.
    """
    bfloat16 = require("torch").bfloat16
    rounded_names: set[str] = set()
    if dtype != bfloat16:
        saved_names = set(saved)
        for name, tensor in model.state_dict().items():
            if tensor.dtype == bfloat16 and name in saved_names:
                rounded_names.add(name)

    model = model.to(device=device, dtype=dtype)
    for name, tensor in model.state_dict().items():
        if name in rounded_names:
            tensor.copy_(saved[name])
    return model


def _require_version(folder: Path) -> None:
    """Raise `ConfigError` unless the checkout has the class of the checkpoint's model."""
    try:
        model_type = json.loads((folder / _MODEL).read_text(encoding="utf-8")).get("model_type")
    except (ValueError, AttributeError) as error:
        raise ConfigError(
            f"checkpoint {folder}: {_MODEL} cannot be read ({error}); copy it again"
        ) from error

    registered = sorted(entry.model_type for entry in require("gr00t.model").MODEL_REGISTRY)
    if model_type in registered:
        return
    if model_type is None:
        cure = "one that LeRobot saved is served by the policy `lerobot`"
    elif "n1_5" in str(model_type).lower():
        cure = (
            "N1.5's code is another: serve it by its own server, and the policy `upstream` in "
            "front of it"
        )
    else:
        cure = "name the checkout of its version"
    raise ConfigError(
        f"checkpoint {folder}: expected a model_type of this checkout, {registered}, got "
        f"{model_type!r}; {cure}"
    )


_FLASH, _PACKED = "flash_attention_2", "packed_sdpa"
_CHECK = "_check_and_enable_flash_attn_2"  # a method of transformers' models up to 4.5


@contextlib.contextmanager
def built_without_flash_attention() -> Iterator[None]:
    """Within the context, allow models that require flash-attention, such as N1.6's backbone, to be
    built without it.
    """
    base: Any = require("transformers").PreTrainedModel
    check = vars(base).get(_CHECK)
    if check is None:  # transformers of N1.7, which falls back to another attention
        yield
        return

    def accept(_cls: Any, config: Any, *_args: Any, **_options: Any) -> Any:
        return config

    setattr(base, _CHECK, classmethod(accept))
    try:
        yield
    finally:
        setattr(base, _CHECK, check)


def use_torch_attention(model: Any) -> None:
    """Replace flash-attention with torch's attention in all layers of a model.

    Torch's attention does not separate the images that N1.6's vision encoder concatenates;
    `packed_attention` does.
    """
    transformers = require("transformers.modeling_utils")
    for module in model.modules():
        config: Any = getattr(module, "config", None)
        if config is not None and getattr(config, "_attn_implementation", None) == _FLASH:
            is_packed = config.model_type.startswith("siglip2")
            config._attn_implementation = _PACKED if is_packed else "sdpa"
    transformers.AttentionInterface.register(_PACKED, packed_attention)


def packed_attention(
    _module: Any,
    query: Any,
    key: Any,
    value: Any,
    _attention_mask: Any = None,
    *,
    scaling: float,
    seq_len_list: Sequence[int],
    **_options: Any,
) -> tuple[Any, None]:
    """Attend within each of several concatenated sequences.

    Args:
        query: (1, heads, tokens, D).
        key: (1, heads, tokens, D).
        value: (1, heads, tokens, D).
        scaling: The factor of the products of queries and keys.
        seq_len_list: The number of tokens of each sequence.

    Returns:
        (1, tokens, heads, D), and None instead of the attention weights.
    """
    attention = require("torch.nn.functional").scaled_dot_product_attention
    lengths = list(seq_len_list)
    # The lengths are equal, so one call with a row for each sequence is sufficient.
    if len(set(lengths)) == 1:
        rows = []
        for tensor in (query, key, value):
            rows.append(tensor[0].unflatten(1, (-1, lengths[0])).transpose(0, 1))
        attended = attention(*rows, scale=scaling)
        return attended.transpose(1, 2).flatten(0, 1)[None], None

    attended_sequences = []
    split_tensors = [tensor.split(lengths, dim=2) for tensor in (query, key, value)]
    for sequence in zip(*split_tensors, strict=True):
        attended_sequences.append(attention(*sequence, scale=scaling))
    return require("torch").cat(attended_sequences, dim=2).transpose(1, 2), None


# The arguments with token masks, (B, S), of the default transformers of N1.6 and N1.7.
_MASKS = ("image_mask", "backbone_attention_mask")


def compile_with(transformer: Any, spare: int, compilation: Compilation) -> None:
    """Compile the transformer that a GR00T network calls in each step of the flow.

    If the transformer masks padding, all prompts are padded to the same length: the length in the
    first call, which is the warm-up, plus `spare` tokens.

    Args:
        transformer: The transformer, whose `forward` is replaced.
        spare: The number of tokens that a prompt may have in addition to the number in the warm-up.
        compilation: The compilation of the policy.
    """
    functional = require("torch.nn.functional")
    forward = transformer.forward
    padded_length = 0  # padded length of prompts in tokens; 0 before the first call

    def denoise(hidden: Any, times: Any, context: Any, *masks: Any) -> Any:
        masks_by_name = dict(zip(_MASKS, masks, strict=False))
        return forward(
            hidden_states=hidden, encoder_hidden_states=context, timestep=times, **masks_by_name
        )

    core = compilation.core("denoise", denoise)

    def call(hidden_states: Any, encoder_hidden_states: Any, timestep: Any, **options: Any) -> Any:
        """Return the core's result.

        It does not use the cache of keys and values, which is only used within one call.
        """
        nonlocal padded_length
        if not compilation.mode:
            return forward(hidden_states, encoder_hidden_states, timestep, **options)

        context = encoder_hidden_states
        masks = [options[name] for name in _MASKS if options.get(name) is not None]
        padded_length = padded_length or context.shape[1] + spare
        missing = padded_length - context.shape[1]
        if masks and missing > 0:
            context = functional.pad(context, (0, 0, 0, missing))
            masks = [functional.pad(mask, (0, missing)) for mask in masks]
        return core(hidden_states, timestep, context, *masks)

    transformer.forward = call


# LIBERO's camera name -> our camera. For other embodiments, our names are the names in the
# checkpoint.
USUAL_CAMERAS = {"image": "front", "wrist_image": "wrist"}
# The part of the robot's state for a group `gripper` with several numbers, as in LIBERO.
GRIPPER_QPOS = "gripper_qpos"


@dataclass(frozen=True)
class Gr00tFrame:
    """An observation under the embodiment's names, with the model's inputs if these need no other
    observation.
    """

    images: dict[str, np.ndarray]  # (H, W, 3) uint8
    state: dict[str, np.ndarray]  # (D,) float32
    inputs: Gr00tInputs | None = None


class Gr00t(ModelPolicy):
    """The policy of a GR00T checkpoint, with one call of the model for many sessions."""

    Config: ClassVar[type] = Gr00tConfig
    config: Gr00tConfig
    model: Gr00tNetwork | None
    trainable = "model.model"
    variation = "prompts are padded to the longest one, or computed in separate passes"

    @property
    def history(self) -> int:
        return 1 if self.model is None else self.model.embodiment.history

    @property
    def state_dim(self) -> int | None:
        return None if self.model is None else sum(self.model.embodiment.state.values())

    @property
    def contract(self) -> Contract:
        """The contract of the embodiment. Before the checkpoint is loaded, it declares only that
        an instruction is needed.
        """
        if self.model is None:
            return Contract(instruction=True)

        robot = self.model.embodiment
        widths = self._state_widths(robot)
        facts: dict[str, Any] = {"action": robot.spec}
        if self.config.state is None:
            facts["state"] = {
                part: StateSpec(width) for part, width in widths.items() if part != GRIPPER
            }
        return self.make_contract(self._cameras(robot), list(widths), robot.horizon, **facts)

    def load(self) -> Gr00tNetwork:
        """Read the checkpoint; raises `ConfigError` for settings that do not fit it."""
        network = Gr00tNetwork.load(self.config)
        self._cameras(network.embodiment)  # raises unless the configured cameras fit
        self.statistics = {
            "parts": list(self._state_widths(network.embodiment)),
            **network.embodiment.ranges,
        }
        compile_with(network.model.action_head.model, self.config.spare_tokens, self.compilation)
        return network

    def perceive(self, obs: Obs) -> Gr00tFrame:
        """Return the images and the state under the embodiment's names, and the model's inputs if
        there is no history.
        """
        network: Gr00tNetwork = self.loaded()
        robot = network.embodiment
        images = camera_images(obs, self._cameras(robot))
        images = {name: image.copy() for name, image in images.items()}

        vector = state_vector(obs, list(self._state_widths(robot)), self.state_dim)
        ends = np.cumsum([0, *robot.state.values()])
        state: dict[str, np.ndarray] = {}
        for group, (start, end) in zip(robot.state, pairwise(ends), strict=True):
            state[group] = vector[start:end]

        if self.history > 1:
            return Gr00tFrame(images, state)
        # Without a history, all offsets are 0.
        all_images = [images] * len(robot.offsets["video"])
        all_states = [state] * len(robot.offsets["state"])
        inputs = network.read(all_images, all_states, self._current_episode().instruction)
        return Gr00tFrame(images, state, inputs)

    def predict(self, rows: Sequence[Row]) -> list[Prediction | Exception]:
        """Compute the chunks of all rows whose observations GR00T's processor accepts."""

        def compute(valid: list[tuple[np.random.Generator, Gr00tInputs]]) -> list[Prediction]:
            rngs, inputs = zip(*valid, strict=True)
            return [Prediction(chunk) for chunk in self.loaded().compute_chunks(rngs, inputs)]

        return compute_valid([attempt(self._inputs, row) for row in rows], compute)

    def _inputs(self, row: Row) -> tuple[np.random.Generator, Gr00tInputs]:
        """Return the random generator and the model's inputs of a row."""
        newest: Gr00tFrame = row.frames[-1]
        if newest.inputs is not None:
            return row.rng, newest.inputs

        network: Gr00tNetwork = self.loaded()
        frames = row.history(self.history)
        offsets = network.embodiment.offsets
        images = [frames[offset - 1].images for offset in offsets["video"]]
        states = [frames[offset - 1].state for offset in offsets["state"]]
        return row.rng, network.read(images, states, row.instruction)

    def _state_widths(self, robot: Embodiment) -> dict[str, int | None]:
        """Return the parts of the robot's state that form the model's state, with their widths
        if known.
        """
        if self.config.state is not None:
            return dict.fromkeys(self.config.state)

        widths: dict[str, int | None] = {}
        for group, width in robot.state.items():
            part = GRIPPER_QPOS if group == GRIPPER and width > 1 else group
            widths[part] = width
        return widths

    def _cameras(self, robot: Embodiment) -> dict[str, str]:
        """Return our camera for each camera of the embodiment."""
        usual = {name: USUAL_CAMERAS.get(name, name) for name in robot.cameras}
        return choose_cameras(self.config.cameras, usual, list(robot.cameras))
