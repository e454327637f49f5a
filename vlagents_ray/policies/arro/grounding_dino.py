"""Grounding DINO (arXiv 2303.05499) as ARRO's detector, through transformers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from pydantic import Field

from vlagents_ray.policies.arro.parts import Detection, Images, PretrainedConfig, load_pretrained, writable
from vlagents_ray.registry import require


class GroundingDinoConfig(PretrainedConfig):
    """The weights, and which boxes count."""

    checkpoint: str = Field(default="IDEA-Research/grounding-dino-tiny", min_length=1)
    threshold: float = Field(default=0.35, ge=0, le=1, description="the least score of a box for a word of a phrase")
    overlap: float = Field(default=0.7, ge=0, le=1, description="intersection over union of two boxes of one thing")
    most: int = Field(default=4, ge=1, description="boxes of a phrase, the best first")


class GroundingDinoDetector:
    """Detects boxes for phrases, or for the objects in a whole instruction.

    One forward pass for each size of images.
    """

    Config: ClassVar[type] = GroundingDinoConfig

    def __init__(self, config: GroundingDinoConfig) -> None:
        self._config = config
        self._model: Any = None
        self._processor: Any = None

    def load(self) -> None:
        """Read the weights; raises `ConfigError` if some are missing."""
        self._model, self._processor = load_pretrained(
            "GroundingDinoForObjectDetection", "GroundingDinoProcessor", self._config
        )

    def detect(self, images: Images, phrases: Sequence[Sequence[str]]) -> list[list[Detection]]:
        """Return boxes, the best first; a box belongs to the phrase with the best of its words."""
        found: list[list[Detection]] = [[] for _ in images]
        for size in {image.shape for image in images}:  # the padding of a mixed batch would change the result
            own = [i for i, image in enumerate(images) if image.shape == size]
            for i, things in zip(own, self._batch([images[i] for i in own], [phrases[i] for i in own]), strict=True):
                found[i] = things
        return found

    def _batch(self, images: Images, phrases: Sequence[Sequence[str]]) -> list[list[Detection]]:
        """Detect objects on images of one size."""
        torch = require("torch")
        texts = [_text(asked) for asked in phrases]
        inputs = self._processor(images=writable(images), text=texts, padding=True, return_tensors="pt")
        with torch.inference_mode():
            outputs = self._model(**inputs.to(self._model.device, self._model.dtype))
        words = outputs.logits.float().sigmoid().cpu().numpy()  # (B, queries, tokens)
        boxes = outputs.pred_boxes.float().cpu().numpy()  # (B, queries, 4): centre and size, as shares of the image
        return [
            self._detections(one, asked, self._scores(scores, asked), own)
            for one, asked, scores, own in zip(images, phrases, words, boxes, strict=True)
        ]

    def _scores(self, words: np.ndarray, phrases: Sequence[str]) -> np.ndarray:
        """Return (queries, phrases): the best score of a phrase's words."""
        offsets = self._processor.tokenizer(_text(phrases), return_offsets_mapping=True)["offset_mapping"]
        scores, start = [], 0
        for phrase in map(_clean, phrases):
            end = start + len(phrase)
            own = [i for i, (left, right) in enumerate(offsets) if start <= left < right <= end]
            scores.append(words[:, own].max(1))
            start = end + len(_BETWEEN)
        return np.stack(scores, 1)

    def _detections(
        self, image: np.ndarray, phrases: Sequence[str], scores: np.ndarray, boxes: np.ndarray
    ) -> list[Detection]:
        height, width = image.shape[:2]
        centre, half = boxes[:, :2], boxes[:, 2:] / 2
        corners = np.concatenate([centre - half, centre + half], 1).clip(0, 1) * np.array([width, height] * 2)
        named = scores.argmax(1)
        found: list[Detection] = []
        for query in np.argsort(-scores.max(1), kind="stable"):
            score, phrase = float(scores[query].max()), phrases[named[query]]
            if score < self._config.threshold:
                break
            same = [one for one in found if one.phrase == phrase]
            if len(same) < self._config.most and all(
                _iou(one.box, corners[query]) < self._config.overlap for one in same
            ):
                found.append(Detection(phrase, corners[query].astype(np.float32), score))
        return found


_BETWEEN = ". "


def _clean(phrase: str) -> str:
    return phrase.lower().replace(".", " ").strip()


def _text(phrases: Sequence[str]) -> str:
    """Join phrases in the form of Grounding DINO's training."""
    return _BETWEEN.join(map(_clean, phrases)) + "."


def _iou(one: np.ndarray, other: np.ndarray) -> float:
    left, top = np.maximum(one[:2], other[:2])
    right, bottom = np.minimum(one[2:], other[2:])
    shared = max(0.0, float(right - left)) * max(0.0, float(bottom - top))
    areas = sum(float((box[2] - box[0]) * (box[3] - box[1])) for box in (one, other))
    return shared / (areas - shared) if areas > shared else 0.0
