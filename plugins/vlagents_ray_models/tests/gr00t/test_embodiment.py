"""The description of a robot in GR00T's files, without NVIDIA's code."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from vlagents_ray import Obs
from vlagents_ray.robot.fit import Trained
from vlagents_ray_models.gr00t import CONFIG, STATISTICS, Embodiment


@pytest.mark.parametrize("ends", [("min", "max"), ("q01", "q99")])
def test_ranges_are_those_of_the_normalisation_in_the_order_of_the_model(
    tmp_path: Path, ends: tuple[str, str]
) -> None:
    groups = {"gripper": [[0.0], [1.0]], "arm": [[-1.0, -2.0], [1.0, 2.0]]}
    statistics = {}
    for group, bounds in groups.items():
        statistics[group] = dict(zip(ends, bounds, strict=True)) | {"mean": bounds[0]}
    config = {"delta_indices": [0], "modality_keys": ["arm", "gripper"]}
    configs = dict.fromkeys(("video", "state", "action"), config)
    settings = {"modality_configs": {"mine": configs}, "use_percentiles": ends[0] == "q01"}
    (tmp_path / CONFIG).write_text(json.dumps({"processor_kwargs": settings}))
    by_embodiment = {"mine": {"state": statistics, "action": statistics}}
    (tmp_path / STATISTICS).write_text(json.dumps(by_embodiment))

    trained = Trained.from_statistics(
        {"parts": ["arm", "gripper"], **Embodiment.from_folder(tmp_path, None).ranges}
    )
    for span in (trained.state, trained.action):
        assert span is not None
        assert [end.tolist() for end in span] == [[-1, -2, 0], [1, 2, 1]]
    state = trained.vector(Obs(gripper=1.0, state={"arm": [0.5, 57.0]}), [])  # type: ignore[dict-item]
    [misfit] = trained.misfits(state, None, None)
    assert misfit.startswith("state[1]: expected -2 to 2, the range of the training, got 57")
