"""GR00T N1.7 as LeRobot 0.6 has it, whose processors have statistics and an embodiment of their own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from vlagents_ray.contract import Contract, StateSpec
from vlagents_ray.dataset_contract import DatasetContract
from vlagents_ray.errors import ConfigError
from vlagents_ray.policies.base import Row
from vlagents_ray.policies.base.model_inputs import GRIPPER
from vlagents_ray.policies.lerobot.kinds.kind import Kind
from vlagents_ray.registry import require

STATE, ACTION = "observation.state", "action"
_BOUNDS = ("min", "max")  # to which states and actions are scaled


class Groot(Kind):
    """GR00T N1.7: flow matching, whose noise is drawn for each session.

    The layers over its language model do not mask padding, so that only observations with prompts of one length, in
    tokens, share a pass.
    """

    batched = True

    @property
    def horizon(self) -> int:
        return int(self.policy._resolve_prediction_horizon(require("torch").empty(1, self._longest, 1)))

    @property
    def usual(self) -> int:
        return min(int(self.policy._action_queue_steps), self.horizon)

    @property
    def _longest(self) -> int:
        return int(self.policy._groot_model.config.action_horizon)

    def draw(self, batch: dict[str, Any], rows: Sequence[Row], leftovers: Sequence[Any]) -> Any:
        from vlagents_ray.policies.sampling_rng import RowDraws

        groups: dict[int, list[int]] = {}
        for place, length in enumerate(batch["attention_mask"].sum(1).tolist()):
            groups.setdefault(int(length), []).append(place)
        chunks: list[Any] = [None] * len(rows)
        for length, places in groups.items():
            with RowDraws([rows[place].rng for place in places]):
                drawn = self.policy.predict_action_chunk(_part(batch, places, length, len(rows)))
            for place, chunk in zip(places, drawn, strict=True):
                chunks[place] = chunk
        return require("torch").stack(chunks).float()


def _part(batch: Mapping[str, Any], places: Sequence[int], length: int, rows: int) -> dict[str, Any]:
    """Return the inputs of some rows, whose prompts have `length` tokens, without the padding before them."""
    grid = batch["image_grid_thw"]
    patches = batch["pixel_values"].split(grid.prod(1).tolist())  # of each image
    views = len(grid) // rows
    images = [place * views + view for place in places for view in range(views)]
    padded = batch["input_ids"].shape
    found = {"pixel_values": require("torch").cat([patches[i] for i in images]), "image_grid_thw": grid[images]}
    for name, value in batch.items():
        if name not in found and hasattr(value, "shape") and value.shape[:1] == (rows,):
            of_tokens = value.shape[:2] == padded
            found[name] = value[places][:, -length:] if of_tokens else value[places]
    return found


def require_groot_statistics(before: Sequence[Any], after: Sequence[Any], settings: Any) -> None:
    """Raise `ConfigError` unless GR00T's processors scale state and actions by usable bounds of the policy's widths.

    LeRobot passes what has no statistics on unchanged, and fills missing bounds with 0 and 1.
    """
    torch = require("torch")
    pack, decode = _step(before, "embodiment_tag"), _step(after, "env_action_dim")
    if pack is None or decode is None:
        raise ConfigError("checkpoint: misses the steps of GR00T N1.7's processors; save it with LeRobot 0.6 again")
    if pack.embodiment_tag not in pack.embodiment_mapping:
        raise ConfigError(
            f"checkpoint: got the embodiment {pack.embodiment_tag!r}, want one of {sorted(pack.embodiment_mapping)}: "
            f"LeRobot would act as the first of them"
        )
    sources = [("policy_preprocessor.json", STATE, pack.stats), ("policy_preprocessor.json", ACTION, pack.stats)]
    if hasattr(decode, "stats"):
        sources.append(("policy_postprocessor.json", ACTION, decode.stats))
    features = {**settings.input_features, **settings.output_features}
    for file, key, stats in sources:
        have = {name: torch.as_tensor(value).float() for name, value in ((stats or {}).get(key) or {}).items()}
        width = features[key].shape[0]
        missing = [name for name in _BOUNDS if name not in have or not have[name].isfinite().all()]
        short = [name for name in _BOUNDS if name in have and have[name].numel() < width]
        if missing or short:
            raise ConfigError(
                f"checkpoint: {file} has no usable {missing or short} of {key!r}, has {sorted(have)}, want {width} "
                f"numbers each; without them its inputs and actions are wrong: save it with its dataset's statistics"
            )


def groot_dataset(before: Sequence[Any]) -> DatasetContract | None:
    """Return the parts of the state that a checkpoint of NVIDIA's names; None if it names none that have a meaning."""
    pack = _step(before, "embodiment_tag")
    names = ((getattr(pack, "modality_config", None) or {}).get("state") or {}).get("modality_keys") or ()
    stats = (getattr(pack, "raw_stats", None) or {}).get("state") or {}
    widths = {name: len(stats.get(name, {}).get("min", ())) for name in names}
    if not widths or not all(widths.values()) or widths.get(GRIPPER, 1) != 1:
        return None
    specs = {name: StateSpec(width) for name, width in widths.items() if name != GRIPPER}
    return DatasetContract(Contract(state=specs), tuple(names))


def _step(steps: Sequence[Any], attribute: str) -> Any:
    return next((step for step in steps if hasattr(step, attribute)), None)
