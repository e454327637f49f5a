"""The entries that this distribution registers, one for each part of a replica."""

from vlagents_ray.registry import RegistryEntry

LIVE = RegistryEntry(
    "vlagents_ray_live.part:LivePart",
    "Shows the sessions on a page, `/live`, and stops their robots from there.",
    by_default=True,
)

RECORD = RegistryEntry(
    "vlagents_ray_live.recording:Recording",
    "Records sessions as LeRobotDatasets.",
    needs=("av", "pyarrow"),
)

SPANS = RegistryEntry(
    "vlagents_ray_live.spans:Spans",
    "Exports OpenTelemetry spans of requests if VLAGENTS_RAY_OTEL=1 is set.",
    by_default=True,
)
