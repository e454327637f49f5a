"""Rates and videos of an evaluation where training is watched: wandb, trackio, TensorBoard."""

from vlagents_ray.evaluate.trackers.tracking import TrackerFeed

__all__ = ["TrackerFeed"]
