"""Pretrained parts of ARRO: Grounding DINO finds objects from words, and SAM 2 segments and tracks
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
    """The weights, and the criteria for boxes."""

    checkpoint: str = Field(default="IDEA-Research/grounding-dino-tiny", min_length=1)
    threshold: float = Field(
        default=0.35, ge=0, le=1, description="the least score of a box for a word of a phrase"
    )
    overlap: float = Field(
        default=0.7,
        ge=0,
        le=1,
        description="intersection over union above which two boxes belong to the same object",
    )
    most: int = Field(
        default=4, ge=1, description="largest number of boxes of a phrase, the best ones first"
    )


class GroundingDinoDetector(Pretrained):
    """Detects boxes for phrases, or for the objects in an instruction, in one pass for each image
    size.
    """

    Config: ClassVar[type] = GroundingDinoConfig
    classes = ("GroundingDinoForObjectDetection", "GroundingDinoProcessor")

    def detect(self, images: Images, phrases: Sequence[Sequence[str]]) -> list[list[Detection]]:
        """Return boxes, the best box first. A box belongs to the phrase of its best word."""
        detections: list[list[Detection]] = [[] for _ in images]
        # Images of each size are processed separately, since the padding of a mixed batch would
        # change the result.
        for shape in {image.shape for image in images}:
            indices = [i for i, image in enumerate(images) if image.shape == shape]
            computed = self._detect_one_size(
                [images[i] for i in indices], [phrases[i] for i in indices]
            )
            for i, image_detections in zip(indices, computed, strict=True):
                detections[i] = image_detections
        return detections

    def _detect_one_size(
        self, images: Images, phrases: Sequence[Sequence[str]]
    ) -> list[list[Detection]]:
        """Return the detections on images of one size."""
        torch = require("torch")
        texts = [_text(image_phrases) for image_phrases in phrases]
        inputs = self._processor(
            images=writable(images), text=texts, padding=True, return_tensors="pt"
        )
        with torch.inference_mode():
            outputs = self._model(**inputs.to(self._model.device, self._model.dtype))
        token_scores = outputs.logits.float().sigmoid().cpu().numpy()  # (B, queries, tokens)
        # Centre and size as shares of the image, (B, queries, 4).
        boxes = outputs.pred_boxes.float().cpu().numpy()

        detections = []
        for i, image in enumerate(images):
            scores = self._phrase_scores(token_scores[i], phrases[i])
            detections.append(self._detections(image, phrases[i], scores, boxes[i]))
        return detections

    def _phrase_scores(self, token_scores: np.ndarray, phrases: Sequence[str]) -> np.ndarray:
        """Return the best score of each phrase's words, (queries, phrases), from the scores of
        all tokens, (queries, tokens).
        """
        tokenizer = self._processor.tokenizer
        offsets = tokenizer(_text(phrases), return_offsets_mapping=True)["offset_mapping"]
        scores = []
        start = 0  # index of the character at which the phrase begins
        for phrase in map(_clean, phrases):
            end = start + len(phrase)
            tokens = [i for i, (left, right) in enumerate(offsets) if start <= left < right <= end]
            scores.append(token_scores[:, tokens].max(1))
            start = end + len(_BETWEEN)
        return np.stack(scores, 1)

    def _detections(
        self, image: np.ndarray, phrases: Sequence[str], scores: np.ndarray, boxes: np.ndarray
    ) -> list[Detection]:
        """Return the detections on an image.

        Args:
            image: The image.
            phrases: The phrases of the image.
            scores: The score of each query for each phrase, (queries, phrases).
            boxes: The box of each query, (queries, 4): centre and size, as shares of the image.
        """
        height, width = image.shape[:2]
        centre, half = boxes[:, :2], boxes[:, 2:] / 2
        corner_shares = np.concatenate([centre - half, centre + half], 1).clip(0, 1)
        corners = corner_shares * np.array([width, height, width, height])

        best_phrases = scores.argmax(1)
        detections: list[Detection] = []
        for query in np.argsort(-scores.max(1), kind="stable"):
            score = float(scores[query].max())
            if score < self._config.threshold:
                break
            phrase = phrases[best_phrases[query]]
            same_phrase = [detection for detection in detections if detection.phrase == phrase]
            is_new = all(
                _box_iou(detection.box, corners[query]) < self._config.overlap
                for detection in same_phrase
            )
            if is_new and len(same_phrase) < self._config.most:
                detections.append(Detection(phrase, corners[query].astype(np.float32), score))
        return detections


_BETWEEN = ". "  # separator between the phrases of a text


def _clean(phrase: str) -> str:
    return phrase.lower().replace(".", " ").strip()


def _text(phrases: Sequence[str]) -> str:
    """Join phrases in the same form as in Grounding DINO's training."""
    return _BETWEEN.join(map(_clean, phrases)) + "."


def _box_iou(first: np.ndarray, second: np.ndarray) -> float:
    """Return the intersection over union of two boxes (4,): left, top, right, bottom."""
    left, top = np.maximum(first[:2], second[:2])
    right, bottom = np.minimum(first[2:], second[2:])
    shared = max(0.0, float(right - left)) * max(0.0, float(bottom - top))
    areas = sum(float((box[2] - box[0]) * (box[3] - box[1])) for box in (first, second))
    return shared / (areas - shared) if areas > shared else 0.0


class Sam2Config(PretrainedConfig):
    """The weights of SAM 2. Weights of the video model also work for images."""

    checkpoint: str = Field(default="facebook/sam2.1-hiera-small", min_length=1)


class Sam2SegmenterConfig(Sam2Config):
    """The settings of proposed regions: a mask for each point of a grid, without uncertain and
    repeated masks.
    """

    points: int = Field(default=16, ge=1, description="points of the grid along each side")
    confidence: float = Field(
        default=0.8,
        ge=0,
        le=1,
        description="the least intersection over union that the model predicts for a mask",
    )
    same: float = Field(
        default=0.7,
        ge=0,
        le=1,
        description="intersection over union above which two masks belong to the same region",
    )


class Sam2Segmenter(Pretrained):
    """Computes masks for boxes and for a grid of points, with one forward pass of the image
    encoder for all images.
    """

    Config: ClassVar[type] = Sam2SegmenterConfig
    classes = ("Sam2Model", "Sam2ImageProcessor")

    def segment(self, images: Images, boxes: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Return a mask for each box, (N, H, W) bool."""
        torch = require("torch")
        masks = []
        embeddings = self._embed(images)
        for image, embedding, image_boxes in zip(images, embeddings, boxes, strict=True):
            height, width = image.shape[:2]
            size = np.array([width, height, width, height], np.float32)
            scaled = torch.as_tensor(image_boxes * (self._side / size), dtype=self._model.dtype)
            outputs = self._decode(embedding, input_boxes=scaled[None], multimask_output=False)
            masks.append(_upscaled(outputs.pred_masks[0, :, 0], image))
        return masks

    def propose(self, images: Images) -> list[np.ndarray]:
        """Return the masks for a grid of points, (M, H, W) bool, the best first."""
        torch = require("torch")
        points = self._config.points
        along_side = (np.arange(points, dtype=np.float32) + 0.5) * (self._side / points)
        grid = np.stack(np.meshgrid(along_side, along_side), -1).reshape(1, -1, 1, 2)
        grid_points = torch.as_tensor(grid, dtype=self._model.dtype)

        proposed = []
        for image, embedding in zip(images, self._embed(images), strict=True):
            outputs = self._decode(embedding, input_points=grid_points, multimask_output=True)
            scores = outputs.iou_scores[0].flatten().float().cpu().numpy()
            logits = outputs.pred_masks[0].flatten(0, 1)
            indices = self._best_different(scores, (logits > 0).cpu().numpy())
            proposed.append(_upscaled(logits[indices], image))
        return proposed

    def _best_different(self, scores: np.ndarray, masks: np.ndarray) -> list[int]:
        """Return the indices of masks, (M, h, w) bool, in the order of their scores, (M,), the best
        mask first.

        Masks that repeat a better mask are excluded.
        """
        indices: list[int] = []
        for i in np.argsort(-scores, kind="stable"):
            if scores[i] < self._config.confidence:
                break
            if not masks[i].any():
                continue
            if all(overlap(masks[i], masks[better]) < self._config.same for better in indices):
                indices.append(int(i))
        return indices

    @property
    def _side(self) -> int:
        """The side of the square to which images are resized, px."""
        return int(self._processor.size["height"])

    def _embed(self, images: Images) -> list[list[Any]]:
        """Return the features of each image, one tensor for each level of the encoder."""
        with require("torch").inference_mode():
            levels = self._model.get_image_embeddings(_pixels(self._processor, images, self._model))
        embeddings = []
        for i in range(len(images)):
            embeddings.append([level[i : i + 1] for level in levels])
        return embeddings

    def _decode(self, embedding: list[Any], **options: Any) -> Any:
        """Return the model's outputs for the features of an image, and prompts as tensors."""
        moved = {}
        for name, value in options.items():
            moved[name] = value.to(self._model.device) if hasattr(value, "to") else value
        with require("torch").inference_mode():
            return self._model(image_embeddings=embedding, **moved)


@dataclass(slots=True)
class _TrackMemory:
    """SAM 2's memory of one camera of one session."""

    # The session of transformers, with only the features and object pointers of the last frames
    # that the model still reads.
    session: Any
    frame: int = 0  # number of the next frame


class Sam2Tracker(Pretrained):
    """The video model with a memory for each session and camera.

    The image encoder, which takes most of the time, runs once for all images. Memory attention runs
    once for each object.
    """

    Config: ClassVar[type] = Sam2Config
    classes = ("Sam2VideoModel", "Sam2VideoProcessor")

    def begin(self, images: Images, masks: Sequence[np.ndarray]) -> list[Any]:
        """Return a memory of the segments of each image."""
        memories = []
        for image_masks in masks:
            session = self._processor.init_video_session(
                inference_device=self._model.device, dtype=self._model.dtype
            )
            self._processor.add_inputs_to_inference_session(
                session,
                frame_idx=0,
                obj_ids=list(range(len(image_masks))),
                input_masks=list(image_masks),
            )
            memories.append(_TrackMemory(session))
        self._advance(images, memories)
        return memories

    def follow(
        self, images: Images, memories: Sequence[Any]
    ) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return the masks on the next frame.

        If the model predicts that a segment is hidden, the segment is not visible.
        """
        followed = []
        for image, outputs in zip(images, self._advance(images, memories), strict=True):
            predicted_visible = (outputs.object_score_logits.flatten() > 0).cpu().numpy()
            masks = _upscaled(outputs.pred_masks[:, 0], image)
            followed.append((masks, predicted_visible & masks.any((1, 2))))
        return followed

    def _advance(self, images: Images, memories: Sequence[_TrackMemory]) -> list[Any]:
        """Return the model's outputs for the next frame of each memory, and update the memories."""
        pixels = _pixels(self._processor.image_processor, images, self._model)
        with require("torch").inference_mode():
            features = self._model.get_image_features(pixels, return_dict=True)

        outputs = []
        for i, memory in enumerate(memories):
            image = slice(i, i + 1)
            image_features = {
                "vision_feats": [level[:, image] for level in features.fpn_hidden_states],
                "vision_pos_embeds": [level[:, image] for level in features.fpn_position_encoding],
            }
            memory.session.cache.cache_vision_features(memory.frame, image_features)
            outputs.append(self._model(memory.session, frame_idx=memory.frame, frame=pixels[i]))
            self._forget(memory)
        return outputs

    def _forget(self, memory: _TrackMemory) -> None:
        """Delete everything that the next frame does not need from a memory.

        The session of transformers would keep all frames with their masks.
        """
        session = memory.session
        session.cache.clear_all()
        session.processed_frames.clear()

        config = self._model.config
        memory.frame += 1
        last_without_features = memory.frame - config.num_maskmem
        last_unused = memory.frame - max(config.num_maskmem, config.max_object_pointers_in_encoder)
        for outputs in session.output_dict_per_obj.values():
            tracked = outputs["non_cond_frame_outputs"]
            for frame in list(tracked):
                if frame <= last_without_features:  # only its object pointer is still used
                    tracked[frame].pop("maskmem_features", None)
                    tracked[frame].pop("maskmem_pos_enc", None)
                if frame <= last_unused:
                    del tracked[frame]
            for output in (*tracked.values(), *outputs["cond_frame_outputs"].values()):
                output.pop("high_res_masks", None)
                output.pop("pred_masks", None)
        for frames in session.frames_tracked_per_obj.values():
            frames.clear()


def _pixels(processor: Any, images: Images, model: Any) -> Any:
    """Return images of any sizes as one (B, 3, side, side) tensor on the model's device."""
    pixels = processor(writable(images), return_tensors="pt")["pixel_values"]
    return pixels.to(model.device, model.dtype)


def _upscaled(logits: Any, image: np.ndarray) -> np.ndarray:
    """Return masks (N, H, W) bool of the image's size, from (N, h, w) logits."""
    if not len(logits):
        return np.zeros((0, *image.shape[:2]), bool)
    torch = require("torch")
    scaled = torch.nn.functional.interpolate(
        logits[None].float(), size=image.shape[:2], mode="bilinear", align_corners=False
    )
    return np.asarray((scaled[0] > 0).cpu().numpy())
