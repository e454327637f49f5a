"""The processors of the policy type `vlagents`, which change nothing: the server normalises and
tokenizes.
"""

from __future__ import annotations

from lerobot.processor import PolicyProcessorPipeline
from lerobot.processor.converters import policy_action_to_transition, transition_to_policy_action
from lerobot.utils.constants import (
    POLICY_POSTPROCESSOR_DEFAULT_NAME,
    POLICY_PREPROCESSOR_DEFAULT_NAME,
)


def make_vlagents_pre_post_processors(
    *_: object, **__: object
) -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
    """Return LeRobot's two pipelines, which have no steps."""
    return (
        PolicyProcessorPipeline(steps=[], name=POLICY_PREPROCESSOR_DEFAULT_NAME),
        PolicyProcessorPipeline(
            steps=[],
            name=POLICY_POSTPROCESSOR_DEFAULT_NAME,
            to_transition=policy_action_to_transition,
            to_output=transition_to_policy_action,
        ),
    )
