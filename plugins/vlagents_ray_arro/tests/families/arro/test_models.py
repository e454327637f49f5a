"""ARRO's learned parts on small random models: shapes, batches, memory, loading."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tiny_arro import make_grounding_dino, make_sam2

from vlagents_ray import Act, Agent, Obs
from vlagents_ray.errors import ConfigError
from vlagents_ray.policies.agent_copies import AgentCopies
from vlagents_ray_arro import Arro
from vlagents_ray_arro.parts import make_part

PHRASES = [["red cube", "the bowl"], ["blue"], ["lift the red cube put on the bowl"]]
SIZES = [(48, 64), (48, 64), (72, 56)]


@pytest.fixture(scope="module")
def sam2(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_sam2(tmp_path_factory.mktemp("sam2"))


@pytest.fixture(scope="module")
def grounding_dino(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_grounding_dino(tmp_path_factory.mktemp("grounding_dino"))


def part(kind: str, name: str, checkpoint: Path, **settings: Any) -> Any:
    loaded = make_part(kind, {name: {"checkpoint": str(checkpoint), **settings}})
    loaded.load()
    return loaded


def images(seed: int = 0) -> list[np.ndarray]:
    """Return images that are read-only, as those of a server are."""
    rng = np.random.default_rng(seed)
    views = [rng.integers(0, 256, (*size, 3), dtype=np.uint8) for size in SIZES]
    for view in views:
        view.flags.writeable = False
    return views


def squares(count: int) -> list[np.ndarray]:
    masks = []
    for size in SIZES:
        mask = np.zeros((count, *size), bool)
        for i in range(count):
            mask[i, 5 + 10 * i : 20 + 10 * i, 5:20] = True
        masks.append(mask)
    return masks


def test_boxes_lie_on_the_image_and_go_by_the_phrases_that_were_asked_for(
    grounding_dino: Path,
) -> None:
    detector = part("detector", "grounding_dino", grounding_dino, threshold=0.0)
    detected = detector.detect(images(), PHRASES)
    for detections, phrases, (height, width) in zip(detected, PHRASES, SIZES, strict=True):
        assert detections
        assert {detection.phrase for detection in detections} <= set(phrases)
        scores = [detection.score for detection in detections]
        assert scores == sorted(scores, reverse=True)
        for detection in detections:
            left, top, right, bottom = detection.box
            assert 0 <= left <= right <= width
            assert 0 <= top <= bottom <= height


@pytest.mark.verifies("parity")
def test_boxes_are_those_that_transformers_finds_itself(grounding_dino: Path) -> None:
    import torch

    detector = part(
        "detector", "grounding_dino", grounding_dino, threshold=0.3, overlap=1.0, most=100
    )
    image, phrases = images()[0], PHRASES[0]
    inputs = detector._processor(images=image.copy(), text=[phrases], return_tensors="pt")
    with torch.no_grad():
        outputs = detector._model(**inputs)
    [theirs] = detector._processor.post_process_grounded_object_detection(
        outputs, threshold=0.3, target_sizes=[image.shape[:2]]
    )

    [ours] = detector.detect([image], [phrases])
    height, width = image.shape[:2]
    boxes = theirs["boxes"].numpy().clip(0, [width, height, width, height])
    assert ours
    for detection in ours:  # theirs also has boxes for the dots between phrases
        [same] = np.nonzero(np.abs(boxes - detection.box).max(1) < 1e-4)[0]
        assert float(theirs["scores"][same]) >= detection.score - 1e-6
        if theirs["text_labels"][same]:
            assert set(theirs["text_labels"][same].split()) & {"red", "cube", "the", "bowl", "."}


@pytest.mark.verifies("batches")
def test_what_is_found_does_not_depend_on_other_images_and_texts(grounding_dino: Path) -> None:
    detector = part("detector", "grounding_dino", grounding_dino, threshold=0.0)
    together = detector.detect(images(), PHRASES)
    for image, phrases, in_batch in zip(images(), PHRASES, together, strict=True):
        [alone] = detector.detect([image], [phrases])
        assert len(alone) == len(in_batch)
        for expected, detection in zip(alone, in_batch, strict=True):
            assert detection.phrase == expected.phrase
            np.testing.assert_allclose(detection.box, expected.box, atol=1e-3)  # px
            np.testing.assert_allclose(detection.score, expected.score, atol=1e-5)


@pytest.mark.verifies("batches")
def test_a_segment_for_each_box_and_the_same_in_any_company(sam2: Path) -> None:
    segmenter = part("segmenter", "sam2", sam2)
    boxes = [np.array([[5, 5, 30, 30], [10, 10, 40, 40]], np.float32)[: i + 1] for i in (0, 1, 1)]
    masks = segmenter.segment(images(), boxes)
    for image, image_boxes, image_masks, size in zip(images(), boxes, masks, SIZES, strict=True):
        assert image_masks.shape == (len(image_boxes), *size)
        assert image_masks.dtype == bool
        [alone] = segmenter.segment([image], [image_boxes])
        assert np.array_equal(alone, image_masks)


def test_regions_are_proposed_without_repetitions(sam2: Path) -> None:
    segmenter = part("segmenter", "sam2", sam2, points=4, confidence=0.0, same=0.5)
    for regions, size in zip(segmenter.propose(images()), SIZES, strict=True):
        assert 1 < len(regions) < 4 * 4 * 3
        assert regions.shape[1:] == size

    certain = part("segmenter", "sam2", sam2, points=4, confidence=1.0)
    for regions, size in zip(certain.propose(images()), SIZES, strict=True):
        assert regions.shape == (0, *size)


@pytest.mark.verifies("parity")
def test_segments_are_followed_as_transformers_does_with_all_frames_kept(sam2: Path) -> None:
    """Three cameras are followed in one batch, and features that are no longer needed are
    deleted.
    """
    import torch

    tracker = part("tracker", "sam2", sam2)
    memories = tracker.begin(images(), squares(2))
    model, processor = tracker._model, tracker._processor

    def pixels(image: np.ndarray) -> Any:
        return processor.image_processor(image.copy(), return_tensors="pt").pixel_values[0]

    complete_sessions = [processor.init_video_session() for _ in SIZES]
    for i, session in enumerate(complete_sessions):
        processor.add_inputs_to_inference_session(
            session, 0, [0, 1], input_masks=list(squares(2)[i])
        )
        model(session, frame_idx=0, frame=pixels(images()[i]))

    for frame in range(1, 10):
        views = images(frame)
        for i, (masks, visible) in enumerate(tracker.follow(views, memories)):
            theirs = model(complete_sessions[i], frame_idx=frame, frame=pixels(views[i]))
            logits = torch.nn.functional.interpolate(
                theirs.pred_masks[:, 0][None], size=SIZES[i], mode="bilinear"
            )[0]
            unsure = logits.abs().numpy() < 1e-3  # on the very edge of a mask
            assert np.array_equal(masks | unsure, (logits.numpy() > 0) | unsure)
            their_visible = (theirs.object_score_logits.flatten() > 0).numpy()
            assert np.array_equal(visible, their_visible & masks.any((1, 2)))


def test_a_memory_stops_growing_and_can_be_moved(sam2: Path) -> None:
    tracker = part("tracker", "sam2", sam2)
    memories = tracker.begin(images()[:1], squares(2)[:1])
    sizes = []
    for frame in range(1, 12):
        tracker.follow(images(frame)[:1], memories)
        sizes.append(len(pickle.dumps(memories[0])))
    assert sizes[-1] == sizes[-4] < 1.2 * sizes[4]
    moved = [pickle.loads(pickle.dumps(memories[0]))]  # noqa: S301 - our own
    [(here, _)], [(there, _)] = (tracker.follow(images(12)[:1], each) for each in (memories, moved))
    assert np.array_equal(here, there)


class Watcher(Agent):
    """Stores the images of its observations."""

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        self.seen = [obs.cameras["front"]]
        return {}

    def act(self, obs: Obs) -> Act:
        self.seen.append(obs.cameras["front"])
        return Act(np.zeros(1, np.float32))


@pytest.mark.verifies("isolation")
def test_sessions_with_all_learned_parts_are_apart(sam2: Path, grounding_dino: Path) -> None:
    policy = Arro.around(
        Watcher(),
        {
            "detector": {
                "grounding_dino": {"checkpoint": str(grounding_dino), "threshold": 0.1, "most": 2}
            },
            "segmenter": {"sam2": {"checkpoint": str(sam2)}},
            "tracker": {"sam2": {"checkpoint": str(sam2)}},
            "selector": None,
        },
    )
    policy.initialize()
    copies = AgentCopies(policy)

    def begun() -> list[Any]:
        sessions: list[Any] = [copies.make() for _ in SIZES]
        for session, image, phrases in zip(sessions, images(), PHRASES, strict=True):
            session.reset(Obs(cameras={"front": image}), " ".join(phrases))
        return sessions

    together, alone = begun(), begun()
    for frame in range(1, 5):
        views = [Obs(cameras={"front": image}) for image in images(frame)]
        acts = policy.act_batch(views, together)
        for obs, session, act in zip(views, alone, acts, strict=True):
            assert isinstance(act, Act)
            assert session.act(obs).info == act.info

    for in_batch, by_itself in zip(together, alone, strict=True):
        for image, expected in zip(in_batch.agent.seen, by_itself.agent.seen, strict=True):
            assert (image != expected).any(-1).mean() < 0.01  # a pixel on the edge of a mask


@pytest.mark.verifies("loading")
@pytest.mark.parametrize(
    ("kind", "name", "file", "message"),
    [
        ("segmenter", "sam2", "model.safetensors", "expected .*safetensors.* got"),
        ("tracker", "sam2", "processor_config.json", "expected .*processor_config.* got"),
        ("detector", "grounding_dino", "config.json", "expected .*config.json.* got"),
    ],
)
def test_a_checkpoint_that_is_not_whole_is_refused(
    kind: str,
    name: str,
    file: str,
    message: str,
    sam2: Path,
    grounding_dino: Path,
    tmp_path: Path,
) -> None:
    for source in (sam2 if name == "sam2" else grounding_dino).iterdir():
        if source.name != file:
            (tmp_path / source.name).write_bytes(source.read_bytes())
    with pytest.raises(ConfigError, match=message):
        part(kind, name, tmp_path)


@pytest.mark.verifies("loading")
def test_weights_that_are_missing_are_never_random(sam2: Path, tmp_path: Path) -> None:
    from safetensors.torch import load_file, save_file

    for source in sam2.iterdir():
        (tmp_path / source.name).write_bytes(source.read_bytes())
    tensors = load_file(tmp_path / "model.safetensors")
    del tensors["memory_encoder.projection.weight"]
    save_file(tensors, tmp_path / "model.safetensors", metadata={"format": "pt"})
    part("segmenter", "sam2", tmp_path)  # which has no memory
    with pytest.raises(
        ConfigError, match=r"does not fill Sam2VideoModel.*memory_encoder\.projection\.weight"
    ):
        part("tracker", "sam2", tmp_path)


def test_no_such_checkpoint(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no such file or folder"):
        part("tracker", "sam2", tmp_path / "none")
