"""The registry entries of this distribution, under the names in the entry points of pyproject.toml.

Import nothing large here.
"""

from vlagents_ray.registry import RegistryEntry

POLICY = RegistryEntry(
    "homing.policy:Homing",
    about="moves each joint towards zero",
    # If one of these modules cannot be imported, `vlagents-ray policies` names the extra that
    # installs it.
    needs=("numpy",),
    extra="model",
    page="https://example.org/homing",
)
LATENCY = RegistryEntry("homing.latency:Latency")
COMMAND = RegistryEntry(
    "homing.command:latency",
    about="Print how long calls of a server's policy take.",
)
