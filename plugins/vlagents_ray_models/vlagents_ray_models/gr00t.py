"""GR00T N1.6 and N1.7 with NVIDIA's own code, Isaac-GR00T."""

from __future__ import annotations

import contextlib
import importlib.util
import json
import os
import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from pydantic import Field

from vlagents_ray.contract import ActionSpec, Contract, StateSpec
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
from vlagents_ray.policies.compilation import Compilation
from vlagents_ray.policies.outcomes import attempt, compute_valid
from vlagents_ray.registry import require
from vlagents_ray_models.model_code import remote_code, use_source

CONFIG, STATISTICS = "processor_config.json", "statistics.json"
# Representations of actions -> whether decoded ones are deltas.
_CONVERTED = {"RELATIVE": False, "DELTA": True}
_SPACES = {"NON_EEF": "joint", "EEF": "ee_pose"}
_ROTATIONS = {"XYZ_ROT6D": "rot6d", "XYZ_ROTVEC": "axis_angle"}
_CURE = "save the checkpoint's processor with its dataset's statistics, as GR00T's training does"


@dataclass(frozen=True)
class Embodiment:
    """The inputs and the actions of one robot of a checkpoint."""

    value: str  # its name, by which GR00T's code finds it, like an `EmbodimentTag`
    cameras: tuple[str, ...]
    state: Mapping[str, int]  # groups and their widths, in the model's order
    action: Mapping[str, int]
    # Of "video" and "state": offsets of the observations read, 0 for the newest.
    moments: Mapping[str, tuple[int, ...]]
    horizon: int  # rows of a chunk
    spec: ActionSpec
    # Of the training: "state" and "action", by group, in the robot's units.
    ranges: Mapping[str, Any]

    @property
    def history(self) -> int:
        """The number of consecutive observations that the model reads."""
        return 1 - min(min(moments, default=0) for moments in self.moments.values())

    @classmethod
    def of(cls, folder: Path, name: str | None) -> Embodiment:
        """Read an embodiment from a processor's folder, by default the only one; raises
        `ConfigError`.
        """
        try:
            settings = json.loads((folder / CONFIG).read_text(encoding="utf-8"))["processor_kwargs"]
            statistics = json.loads((folder / STATISTICS).read_text(encoding="utf-8"))
            configs = settings["modality_configs"]
        except FileNotFoundError as error:
            have = sorted(one.name for one in folder.iterdir())
            raise ConfigError(
                f"checkpoint {folder}: has no {Path(error.filename).name}, has {have}; {_CURE}"
            ) from error
        except (ValueError, KeyError, TypeError) as error:
            raise ConfigError(
                f"checkpoint {folder}: {CONFIG} and {STATISTICS} are not those of GR00T's "
                f"processor ({type(error).__name__}: {error}); {_CURE}"
            ) from error
        known = sorted(set(configs) & set(statistics))
        chosen = name if name is not None else known[0] if len(known) == 1 else None
        if chosen is None or chosen not in known:
            others = sorted(set(configs) - set(statistics))
            raise ConfigError(
                f"embodiment: got {name!r}, want one of "
                f"{known}{f'; {others} have no statistics in this checkpoint' if others else ''}"
            )
        config, numbers = configs[chosen], statistics[chosen]
        names = ("q01", "q99") if settings.get("use_percentiles") else ("min", "max")
        ranges = {
            kind: {
                group: _range(folder, numbers, kind, group, names)
                for group in config[kind]["modality_keys"]
            }
            for kind in ("state", "action")
        }
        widths = {
            kind: {group: len(one[names[0]]) for group, one in groups.items()}
            for kind, groups in ranges.items()
        }
        return cls(
            chosen,
            tuple(config["video"]["modality_keys"]),
            widths["state"],
            widths["action"],
            {kind: tuple(config[kind]["delta_indices"]) for kind in ("video", "state")},
            len(config["action"]["delta_indices"]),
            _action(
                config["action"].get("action_configs") or (),
                sum(widths["action"].values()),
                converted=bool(settings.get("use_relative_action")),
            ),
            ranges,
        )

    def require_fits(self, config: Any) -> None:
        """Raise `ConfigError` unless the model of `config` has room for the state, the actions
        and the chunk's rows.
        """
        for what, got, most in (
            ("state", sum(self.state.values()), config.max_state_dim),
            ("action", sum(self.action.values()), config.max_action_dim),
            ("chunk", self.horizon, config.action_horizon),
        ):
            if got > most:
                raise ConfigError(
                    f"embodiment {self.value!r}: its {what} has {got} "
                    f"{'rows' if what == 'chunk' else 'numbers'}, the "
                    f"model at most {most}: is the processor that of another checkpoint?"
                )


def _range(
    folder: Path, numbers: Mapping[str, Any], kind: str, group: str, names: tuple[str, str]
) -> dict[str, Any]:
    """Return the bounds of a group of the state or of actions, which are finite."""
    bounds = [
        np.asarray(numbers.get(kind, {}).get(group, {}).get(name, ()), np.float64) for name in names
    ]
    if bounds[0].ndim != 1 or not bounds[0].size or bounds[0].shape != bounds[1].shape:
        raise ConfigError(
            f"checkpoint {folder}: {STATISTICS} has no {list(names)} of {kind} {group!r}, has "
            f"those of {sorted(numbers.get(kind, {}))}; without them its numbers have no units: "
            f"{_CURE}"
        )
    if not np.isfinite(bounds).all():
        raise ConfigError(
            f"checkpoint {folder}: {list(names)} of {kind} {group!r} are not all finite; {_CURE}"
        )
    return dict(zip(names, (bound.tolist() for bound in bounds), strict=True))


def _action(groups: Any, dim: int, *, converted: bool) -> ActionSpec:
    """Describe the actions by their relative groups.

    Checkpoints call all other groups absolute, even displacements such as LIBERO's, so the contract
    does not state it. GR00T converts relative groups to absolute ones if the processor has
    `use_relative_action`.
    """
    stated = [group for group in groups if converted and group["rep"] in _CONVERTED]
    tables: Any = {
        "delta": (_CONVERTED, "rep"),
        "space": (_SPACES, "type"),
        "rotation": (_ROTATIONS, "format"),
    }
    found = {
        name: {table.get(group[key]) for group in stated} for name, (table, key) in tables.items()
    }
    return ActionSpec(dim=dim, **{name: one.pop() for name, one in found.items() if len(one) == 1})


class Gr00tConfig(ModelConfig):
    """Settings of GR00T, in addition to those of all models."""

    checkpoint: str = Field(
        min_length=1,
        description="folder of GR00T's training, such as outputs/checkpoint-{step}, or hub id: "
        "org/name, "
        "org/name@COMMIT",
    )
    source_dir: str | None = Field(
        default=None,
        description="a checkout of Isaac-GR00T; unset: the variable GR00T_SRC, or what is "
        "installed",
    )
    embodiment: str | None = Field(
        default=None,
        description="the checkpoint's name of the robot, such as new_embodiment; unset: its only "
        "one",
    )
    backbone: str | None = Field(
        default=None,
        description="N1.7: folder of the vision-language model that the checkpoint names, "
        "nvidia/Cosmos-Reason2-2B, "
        "whose path must contain that name; unset: from the hub or its cache",
    )
    steps: int | None = Field(
        default=None, ge=1, description="steps of the flow; unset: the checkpoint's, usually 4"
    )
    spare_tokens: int = Field(
        default=32,
        ge=0,
        description="compiled: tokens that a prompt may have beyond two words; a longer one runs "
        "without",
    )
    trust_remote_code: bool = Field(
        default=False,
        description="run Python code in the checkpoint or its backbone: write access to them then "
        "gives all rights "
        "of this process",
    )


SOURCE = "GR00T_SRC"
_MODEL = "config.json"


@dataclass(frozen=True)
class Gr00tNetwork:
    """A loaded checkpoint, for one embodiment."""

    model: Any
    processor: Any
    embodiment: Embodiment
    # Held while a thread's processor reads an observation: its transforms store their parameters,
    # and it changes the warning filters of the whole process.
    reading: threading.Lock = field(default_factory=threading.Lock, repr=False, compare=False)

    @classmethod
    def load(cls, config: Gr00tConfig) -> Gr00tNetwork:
        """Read a checkpoint; raises `ConfigError` if a part of it is missing, unknown or
        randomly initialised.
        """
        code = _use_checkout(config.source_dir)
        folder = find_checkpoint(
            config.checkpoint, config.checkpoint_step, needs=[_MODEL, "*.safetensors"]
        )
        _require_version(folder)
        beside = folder / "processor"  # where N1.7's training saves it
        about = folder if (folder / CONFIG).is_file() or not beside.is_dir() else beside
        embodiment = Embodiment.of(about, config.embodiment)
        device = torch_device(config.device)
        dtype = torch_dtype(config.dtype, device)
        other = {} if config.backbone is None else {"model_name": config.backbone}
        transformers = require("transformers")
        # flash-attention, if it is installed.
        computes = device.type == "cuda" and dtype.itemsize == 2
        flash = computes and bool(require("transformers.utils").is_flash_attn_2_available())
        with (
            remote_code(allowed=config.trust_remote_code, source=code),
            contextlib.nullcontext() if flash else built_without_flash_attention(),
        ):
            try:
                model = transformers.AutoModel.from_pretrained(folder, torch_dtype=dtype, **other)
                processor = transformers.AutoProcessor.from_pretrained(about, **other)
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
        if not flash:
            use_torch_attention(model)
        saved = SavedTensors.open(folder)
        model = _converted(model.eval().requires_grad_(False), saved, device, dtype)
        require_loaded(model, saved)
        embodiment.require_fits(model.config)
        if embodiment.value not in processor.embodiment_id_mapping:
            raise ConfigError(
                f"embodiment {embodiment.value!r}: has no number in embodiment_id.json, which has "
                f"{sorted(processor.embodiment_id_mapping)}; save the checkpoint's processor with "
                "it"
            )
        if config.steps is not None:
            model.action_head.num_inference_timesteps = config.steps
        processor.eval()
        return cls(model, processor, embodiment)

    @cached_property
    def masks_padding(self) -> bool:
        """Whether all layers above the language model mask padding, as N1.6's usual transformer
        does.
        """
        over = getattr(self.model.action_head, "vl_self_attention", None)
        plain = over is None or not list(over.parameters())
        return plain and bool(self.model.config.use_alternate_vl_dit)

    def inputs(
        self,
        images: Sequence[dict[str, np.ndarray]],
        states: Sequence[dict[str, np.ndarray]],
        instruction: str,
    ) -> dict[str, Any]:
        """Return the model's inputs for one row, to be passed to `chunks`.

        Args:
            images: For each moment of the embodiment's video, oldest first, (H, W, 3) uint8 by
                camera.
            states: For each moment of its state, (D,) float32 by group.
            instruction: The task in words.
        """
        types, robot = require("gr00t.data.types"), self.embodiment
        raw = {group: np.stack([one[group] for one in states]) for group in robot.state}
        step = types.VLAStepData(
            images={camera: [one[camera] for one in images] for camera in robot.cameras},
            states=raw,
            actions={},
            text=instruction,
            embodiment=robot,
        )
        with self.reading:
            processed = self.processor(
                [{"type": types.MessageType.EPISODE_STEP.value, "content": step}]
            )
        return {"processed": processed, "raw": raw}

    def chunks(
        self, rngs: Sequence[np.random.Generator], inputs: Sequence[dict[str, Any]]
    ) -> list[np.ndarray]:
        """Compute the chunks of rows, (horizon, D) float32 each, in one pass, or in one for each
        length of prompts.

        Args:
            rngs: The generator of each row's noise.
            inputs: The result of `inputs` for each row.
        """
        whole = self._collated(inputs)
        lengths = whole["inputs"]["attention_mask"].sum(1).tolist()
        if self.masks_padding or len(set(lengths)) == 1:
            return self._chunks(rngs, inputs, whole)
        found: dict[int, np.ndarray] = {}
        for length in sorted(set(lengths)):
            places = [place for place, one in enumerate(lengths) if one == length]
            some = [inputs[place] for place in places]
            chunks = self._chunks([rngs[place] for place in places], some, self._collated(some))
            found |= zip(places, chunks, strict=True)
        return [found[place] for place in range(len(inputs))]

    def _collated(self, inputs: Sequence[dict[str, Any]]) -> Any:
        return self.processor.collator([one["processed"] for one in inputs])

    def _chunks(
        self, rngs: Sequence[np.random.Generator], inputs: Sequence[dict[str, Any]], collated: Any
    ) -> list[np.ndarray]:
        from vlagents_ray_models.sampling_rng import RowDraws

        with require("torch").inference_mode(), RowDraws(rngs, self.model.action_head):
            drawn = fetch(self.model.get_action(**collated)["action_pred"].float())
        raw = {
            group: np.stack([one["raw"][group] for one in inputs])
            for group in self.embodiment.state
        }
        decoded = self.processor.decode_action(drawn, self.embodiment, raw)
        return list(
            np.concatenate([decoded[group] for group in self.embodiment.action], axis=-1).astype(
                np.float32
            )
        )


def _use_checkout(source_dir: str | None) -> Path:
    """Make GR00T's code importable; return the folder of its models, which hold code that
    transformers imports.
    """
    use_source("gr00t", SOURCE, source_dir)
    if importlib.util.find_spec("gr00t.policy") is None:
        raise ConfigError(
            f"{source_dir or os.environ.get(SOURCE) or 'gr00t'}: is GR00T's code of N1.5 or "
            "before, want that of N1.6 or N1.7; serve N1.5 by its own server, and the policy "
            "`upstream` in front of it"
        )
    # Otherwise its import queries PyPI for a newer version.
    os.environ.setdefault("NO_ALBUMENTATIONS_UPDATE", "1")
    ensure_torchvision()
    return Path(str(require("gr00t.model").__file__)).parent


def _converted(model: Any, saved: SavedTensors, device: Any, dtype: Any) -> Any:
    """Move a model to a device and a dtype; N1.6's backbone is always read in bfloat16, which
    rounds.
    """
    rounded, held = require("torch").bfloat16, set(saved)
    names = {
        name
        for name, one in model.state_dict().items()
        if one.dtype == rounded != dtype and name in held
    }
    model = model.to(device=device, dtype=dtype)
    for name, tensor in model.state_dict().items():
        if name in names:
            tensor.copy_(saved[name])
    return model


def _require_version(folder: Path) -> None:
    """Raise `ConfigError` unless the checkout has the class of the checkpoint's model."""
    try:
        kind = json.loads((folder / _MODEL).read_text(encoding="utf-8")).get("model_type")
    except (ValueError, AttributeError) as error:
        raise ConfigError(
            f"checkpoint {folder}: {_MODEL} cannot be read ({error}); copy it again"
        ) from error
    known = sorted(one.model_type for one in require("gr00t.model").MODEL_REGISTRY)
    if kind not in known:
        cure = (
            (
                "N1.5's code is another: serve it by its own server, and the policy `upstream` in "
                "front of it"
            )
            if "n1_5" in str(kind).lower()
            else "one that LeRobot saved is served by the policy `lerobot`"
            if kind is None
            else "name the checkout of its version"
        )
        raise ConfigError(
            f"checkpoint {folder}: got model_type {kind!r}, this checkout has {known}; {cure}"
        )


_FLASH, _PACKED = "flash_attention_2", "packed_sdpa"
_CHECK = "_check_and_enable_flash_attn_2"  # a method of transformers' models, up to 4.5


@contextlib.contextmanager
def built_without_flash_attention() -> Iterator[None]:
    """Allow models that require flash-attention, such as N1.6's backbone, to be built without it
    in this context.
    """
    base: Any = require("transformers").PreTrainedModel
    check = vars(base).get(_CHECK)
    if check is None:  # newer: N1.7's, which falls back to another attention
        yield
        return
    setattr(base, _CHECK, classmethod(lambda _, config, *__, **___: config))
    try:
        yield
    finally:
        setattr(base, _CHECK, check)


def use_torch_attention(model: Any) -> None:
    """Replace flash-attention by torch's attention; N1.6's vision tower attends within each
    image.
    """
    transformers = require("transformers.modeling_utils")
    for module in model.modules():
        config: Any = getattr(module, "config", None)
        if config is not None and getattr(config, "_attn_implementation", None) == _FLASH:
            packed = config.model_type.startswith("siglip2")
            config._attn_implementation = _PACKED if packed else "sdpa"
    transformers.AttentionInterface.register(_PACKED, packed_attention)


def packed_attention(
    _: Any,
    query: Any,
    key: Any,
    value: Any,
    __: Any = None,
    *,
    scaling: float,
    seq_len_list: Sequence[int],
    **___: Any,
) -> tuple[Any, None]:
    """Attend within each of several concatenated sequences.

    Args:
        query: (1, heads, tokens, D).
        key: (1, heads, tokens, D).
        value: (1, heads, tokens, D).
        scaling: The factor of the products of queries and keys.
        seq_len_list: The number of tokens of each sequence.

    Returns:
        (1, tokens, heads, D), and None in place of the weights.
    """
    attention = require("torch.nn.functional").scaled_dot_product_attention
    if len(set(seq_len_list)) == 1:  # equal lengths: one call, with a row for each sequence
        rows = [
            one[0].unflatten(1, (-1, seq_len_list[0])).transpose(0, 1)
            for one in (query, key, value)
        ]
        return attention(*rows, scale=scaling).transpose(1, 2).flatten(0, 1)[None], None
    parts = zip(*(one.split(list(seq_len_list), dim=2) for one in (query, key, value)), strict=True)
    return require("torch").cat(
        [attention(*part, scale=scaling) for part in parts], dim=2
    ).transpose(1, 2), None


# Of tokens (B, S), arguments of N1.6's usual transformer and N1.7's.
_MASKS = ("image_mask", "backbone_attention_mask")


def compile_with(transformer: Any, spare: int, compilation: Compilation) -> None:
    """Compile the transformer that a GR00T network calls in each step of the flow.

    If it masks padding, prompts with up to `spare` tokens more than those of the first call, the
    warm-up's, are padded to one shape.
    """
    functional, forward = require("torch.nn.functional"), transformer.forward

    def denoise(hidden: Any, times: Any, seen: Any, *masks: Any) -> Any:
        masked = dict(zip(_MASKS, masks, strict=False))
        return forward(hidden_states=hidden, encoder_hidden_states=seen, timestep=times, **masked)

    core, length = compilation.core("denoise", denoise), 0

    def call(hidden_states: Any, encoder_hidden_states: Any, timestep: Any, **given: Any) -> Any:
        """Return the core's result; the cache of keys and values is not used, as it is of this
        act alone.
        """
        nonlocal length
        if not compilation.mode:
            return forward(hidden_states, encoder_hidden_states, timestep, **given)
        seen, masks = (
            encoder_hidden_states,
            [given[name] for name in _MASKS if given.get(name) is not None],
        )
        length = length or seen.shape[1] + spare
        if masks and (missing := length - seen.shape[1]) > 0:
            seen = functional.pad(seen, (0, 0, 0, missing))
            masks = [functional.pad(mask, (0, missing)) for mask in masks]
        return core(hidden_states, timestep, seen, *masks)

    transformer.forward = call


# Of LIBERO; other embodiments use the checkpoint's names.
USUAL_CAMERAS = {"image": "front", "wrist_image": "wrist"}
# The part of the state for a group `gripper` with several numbers, as in LIBERO.
GRIPPER_QPOS = "gripper_qpos"


@dataclass(frozen=True)
class SeenByGr00t:
    """An observation by the embodiment's names, and the model's inputs if they need no other
    observation.
    """

    images: dict[str, np.ndarray]  # (H, W, 3) uint8
    state: dict[str, np.ndarray]  # (D,) float32
    inputs: dict[str, Any] | None = None


class Gr00t(ModelPolicy):
    """The policy of a GR00T checkpoint, with one call of the model for many sessions."""

    Config: ClassVar[type] = Gr00tConfig
    config: Gr00tConfig
    model: Gr00tNetwork | None
    trainable = "model.model"

    @property
    def history(self) -> int:
        return 1 if self.model is None else self.model.embodiment.history

    @property
    def state_dim(self) -> int | None:
        return None if self.model is None else sum(self.model.embodiment.state.values())

    @property
    def contract(self) -> Contract:
        """The contract of the embodiment; before the checkpoint is loaded it states only the
        instruction.
        """
        if self.model is None:
            return Contract(instruction=True)
        robot = self.model.embodiment
        parts = self._parts(robot)
        own = {part: StateSpec(width) for part, width in parts.items() if part != GRIPPER}
        state = {"state": own} if self.config.state is None else {}
        return self.stated(
            self._cameras(robot), list(parts), robot.horizon, action=robot.spec, **state
        )

    def load(self) -> Gr00tNetwork:
        """Read the checkpoint; raises `ConfigError` for settings that do not fit it."""
        network = Gr00tNetwork.load(self.config)
        self._cameras(network.embodiment)
        self.statistics = {
            "parts": list(self._parts(network.embodiment)),
            **network.embodiment.ranges,
        }
        compile_with(network.model.action_head.model, self.config.spare_tokens, self.compilation)
        return network

    def perceive(self, obs: Obs) -> SeenByGr00t:
        """Return the images and the state by the embodiment's names, and, without a history, the
        model's inputs.
        """
        network = self.loaded()
        robot = network.embodiment
        images = {
            name: image.copy() for name, image in camera_images(obs, self._cameras(robot)).items()
        }
        vector = state_vector(obs, list(self._parts(robot)), self.state_dim)
        ends = np.cumsum([0, *robot.state.values()])
        state = {
            group: vector[a:b] for group, (a, b) in zip(robot.state, pairwise(ends), strict=True)
        }
        if self.history > 1:
            return SeenByGr00t(images, state)
        moments = (len(robot.moments["video"]), len(robot.moments["state"]))
        inputs = network.inputs(
            [images] * moments[0], [state] * moments[1], self._begun().instruction
        )
        return SeenByGr00t(images, state, inputs)

    def predict(self, rows: Sequence[Row]) -> list[Prediction | Exception]:
        """Compute the chunks of all rows whose observations GR00T's processor accepts."""

        def compute(good: list[tuple[np.random.Generator, dict[str, Any]]]) -> list[Prediction]:
            return [Prediction(chunk) for chunk in self.loaded().chunks(*zip(*good, strict=True))]

        return compute_valid([attempt(self._inputs, row) for row in rows], compute)

    def _inputs(self, row: Row) -> tuple[np.random.Generator, dict[str, Any]]:
        """Return the random generator and the model's inputs of a row."""
        newest = row.frames[-1]
        if newest.inputs is not None:
            return row.rng, newest.inputs
        network: Gr00tNetwork = self.loaded()
        frames = row.history(self.history)
        moments = network.embodiment.moments
        images = [frames[moment - 1].images for moment in moments["video"]]
        state = [frames[moment - 1].state for moment in moments["state"]]
        return row.rng, network.inputs(images, state, row.instruction)

    def _parts(self, robot: Embodiment) -> dict[str, int | None]:
        """Return the parts of our state that form the model's, with their widths if known."""
        if self.config.state is not None:
            return dict.fromkeys(self.config.state)
        return {
            GRIPPER_QPOS if group == GRIPPER and width > 1 else group: width
            for group, width in robot.state.items()
        }

    def _cameras(self, robot: Embodiment) -> dict[str, str]:
        usual = {name: USUAL_CAMERAS.get(name, name) for name in robot.cameras}
        return choose_cameras(self.config.cameras, usual, list(robot.cameras))
