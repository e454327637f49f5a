"""Pretrained parts of ARRO: Grounding DINO finds objects by words, and SAM 2 segments and tracks
them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from pydantic import Field

from vlagents_ray.registry import require
from vlagents_ray_arro.parts import (
    Detection,
    Images,
    Pretrained,
    PretrainedConfig,
    overlap,
    writable,
)


class GroundingDinoConfig(PretrainedConfig):
    """The weights, and which boxes count."""

    checkpoint: str = Field(default="IDEA-Research/grounding-dino-tiny", min_length=1)
    threshold: float = Field(
        default=0.35, ge=0, le=1, description="the least score of a box for a word of a phrase"
    )
    overlap: float = Field(
        default=0.7, ge=0, le=1, description="intersection over union of two boxes of one thing"
    )
    most: int = Field(default=4, ge=1, description="boxes of a phrase, the best first")


class GroundingDinoDetector(Pretrained):
    """Detects boxes for phrases, or for the objects in an instruction, in one pass for each size
    of images.
    """

    Config: ClassVar[type] = GroundingDinoConfig
    classes = ("GroundingDinoForObjectDetection", "GroundingDinoProcessor")

    def detect(self, images: Images, phrases: Sequence[Sequence[str]]) -> list[list[Detection]]:
        """Return boxes, the best first; a box belongs to the phrase with the best of its words."""
        found: list[list[Detection]] = [[] for _ in images]
        # The padding of a mixed batch would change the result.
        for size in {image.shape for image in images}:
            own = [i for i, image in enumerate(images) if image.shape == size]
            for i, things in zip(
                own, self._batch([images[i] for i in own], [phrases[i] for i in own]), strict=True
            ):
                found[i] = things
        return found

    def _batch(self, images: Images, phrases: Sequence[Sequence[str]]) -> list[list[Detection]]:
        torch = require("torch")
        texts = [_text(asked) for asked in phrases]
        inputs = self._processor(
            images=writable(images), text=texts, padding=True, return_tensors="pt"
        )
        with torch.inference_mode():
            outputs = self._model(**inputs.to(self._model.device, self._model.dtype))
        words = outputs.logits.float().sigmoid().cpu().numpy()  # (B, queries, tokens)
        # (B, queries, 4): centre and size, as shares of the image.
        boxes = outputs.pred_boxes.float().cpu().numpy()
        return [
            self._detections(one, asked, self._scores(scores, asked), own)
            for one, asked, scores, own in zip(images, phrases, words, boxes, strict=True)
        ]

    def _scores(self, words: np.ndarray, phrases: Sequence[str]) -> np.ndarray:
        """Return (queries, phrases): the best score of a phrase's words."""
        offsets = self._processor.tokenizer(_text(phrases), return_offsets_mapping=True)[
            "offset_mapping"
        ]
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
        corners = np.concatenate([centre - half, centre + half], 1).clip(0, 1) * np.array(
            [width, height] * 2
        )
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


class Sam2Config(PretrainedConfig):
    """The weights of SAM 2; those of the video model also serve images."""

    checkpoint: str = Field(default="facebook/sam2.1-hiera-small", min_length=1)


class Sam2SegmenterConfig(Sam2Config):
    """The proposal of regions: a mask for each point of a grid, without uncertain and repeated
    ones.
    """

    points: int = Field(default=16, ge=1, description="of the grid, along each side")
    confidence: float = Field(
        default=0.8, ge=0, le=1, description="the least intersection over union it expects"
    )
    same: float = Field(
        default=0.7, ge=0, le=1, description="intersection over union of two masks of one region"
    )


class Sam2Segmenter(Pretrained):
    """Computes masks for boxes and for a grid of points; all images in one forward pass of the
    image encoder.
    """

    Config: ClassVar[type] = Sam2SegmenterConfig
    classes = ("Sam2Model", "Sam2ImageProcessor")

    def segment(self, images: Images, boxes: Sequence[np.ndarray]) -> list[np.ndarray]:
        torch = require("torch")
        made = []
        for image, embedded, own in zip(images, self._embedded(images), boxes, strict=True):
            # width, height, width, height.
            corners = np.array([image.shape[1], image.shape[0]] * 2, np.float32)
            scaled = torch.as_tensor(own * (self._side / corners), dtype=self._model.dtype)
            outputs = self._decoded(embedded, input_boxes=scaled[None], multimask_output=False)
            made.append(_upscaled(outputs.pred_masks[0, :, 0], image))
        return made

    def propose(self, images: Images) -> list[np.ndarray]:
        torch = require("torch")
        along = (np.arange(self._config.points, dtype=np.float32) + 0.5) * (
            self._side / self._config.points
        )
        grid = torch.as_tensor(
            np.stack(np.meshgrid(along, along), -1).reshape(1, -1, 1, 2), dtype=self._model.dtype
        )
        proposed = []
        for image, embedded in zip(images, self._embedded(images), strict=True):
            outputs = self._decoded(embedded, input_points=grid, multimask_output=True)
            scores = outputs.iou_scores[0].flatten().float().cpu().numpy()
            masks = (outputs.pred_masks[0].flatten(0, 1) > 0).cpu().numpy()
            kept: list[int] = []
            for i in np.argsort(-scores, kind="stable"):
                if scores[i] < self._config.confidence:
                    break
                if masks[i].any() and all(
                    overlap(masks[i], masks[k]) < self._config.same for k in kept
                ):
                    kept.append(int(i))
            proposed.append(_upscaled(outputs.pred_masks[0].flatten(0, 1)[kept], image))
        return proposed

    @property
    def _side(self) -> int:
        """The side of the square to which images are resized, px."""
        return int(self._processor.size["height"])

    def _embedded(self, images: Images) -> list[list[Any]]:
        with require("torch").inference_mode():
            levels = self._model.get_image_embeddings(_pixels(self._processor, images, self._model))
        return [[level[i : i + 1] for level in levels] for i in range(len(images))]

    def _decoded(self, embedded: list[Any], **prompts: Any) -> Any:
        prompts = {
            key: one.to(self._model.device) if hasattr(one, "to") else one
            for key, one in prompts.items()
        }
        with require("torch").inference_mode():
            return self._model(image_embeddings=embedded, **prompts)


@dataclass(slots=True)
class _TrackMemory:
    """SAM 2's memory of one camera of one session."""

    # transformers' session: features and pointers of the last frames, only those that the model
    # uses.
    session: Any
    frame: int = 0


class Sam2Tracker(Pretrained):
    """The video model with a memory for each session and camera.

    The image encoder, which takes most of the time, runs once for all images; memory attention runs
    object by object.
    """

    Config: ClassVar[type] = Sam2Config
    classes = ("Sam2VideoModel", "Sam2VideoProcessor")

    def begin(self, images: Images, masks: Sequence[np.ndarray]) -> list[Any]:
        memories = []
        for own in masks:
            memory = _TrackMemory(
                self._processor.init_video_session(
                    inference_device=self._model.device, dtype=self._model.dtype
                )
            )
            self._processor.add_inputs_to_inference_session(
                memory.session, frame_idx=0, obj_ids=list(range(len(own))), input_masks=list(own)
            )
            memories.append(memory)
        self._advance(images, memories)
        return memories

    def follow(
        self, images: Images, memories: Sequence[Any]
    ) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return the masks on the next frame; a segment that the model predicts to be out of
        sight is not visible.
        """
        followed = []
        for image, outputs in zip(images, self._advance(images, memories), strict=True):
            seen = (outputs.object_score_logits.flatten() > 0).cpu().numpy()
            masks = _upscaled(outputs.pred_masks[:, 0], image)
            followed.append((masks, seen & masks.any((1, 2))))
        return followed

    def _advance(self, images: Images, memories: Sequence[_TrackMemory]) -> list[Any]:
        pixels = _pixels(self._processor.image_processor, images, self._model)
        with require("torch").inference_mode():
            features = self._model.get_image_features(pixels, return_dict=True)
        outputs = []
        for i, memory in enumerate(memories):
            own = {
                "vision_feats": [level[:, i : i + 1] for level in features.fpn_hidden_states],
                "vision_pos_embeds": [
                    level[:, i : i + 1] for level in features.fpn_position_encoding
                ],
            }
            memory.session.cache.cache_vision_features(memory.frame, own)
            outputs.append(self._model(memory.session, frame_idx=memory.frame, frame=pixels[i]))
            self._forget(memory)
        return outputs

    def _forget(self, memory: _TrackMemory) -> None:
        """Keep only what the next frame needs: transformers' session would keep all frames with
        their masks.
        """
        session = memory.session
        session.cache.clear_all()
        session.processed_frames.clear()
        config = self._model.config
        following = memory.frame + 1
        for outputs in session.output_dict_per_obj.values():
            tracked = outputs["non_cond_frame_outputs"]
            for frame in list(tracked):
                if frame <= following - config.num_maskmem:  # only its object pointer is still used
                    tracked[frame].pop("maskmem_features", None)
                    tracked[frame].pop("maskmem_pos_enc", None)
                if frame <= following - max(
                    config.num_maskmem, config.max_object_pointers_in_encoder
                ):
                    del tracked[frame]
            for output in (*tracked.values(), *outputs["cond_frame_outputs"].values()):
                output.pop("high_res_masks", None)
                output.pop("pred_masks", None)
        for frames in session.frames_tracked_per_obj.values():
            frames.clear()
        memory.frame = following


def _pixels(processor: Any, images: Images, model: Any) -> Any:
    """Return images of any sizes as one (B, 3, side, side) tensor on the model's device."""
    return processor(writable(images), return_tensors="pt")["pixel_values"].to(
        model.device, model.dtype
    )


def _upscaled(logits: Any, image: np.ndarray) -> np.ndarray:
    """Return masks (N, H, W) bool of the image's size, from (N, h, w) logits."""
    if not len(logits):
        return np.zeros((0, *image.shape[:2]), bool)
    torch = require("torch")
    scaled = torch.nn.functional.interpolate(
        logits[None].float(), size=image.shape[:2], mode="bilinear", align_corners=False
    )
    return np.asarray((scaled[0] > 0).cpu().numpy())
