"""An evaluation in one file, which others can cite, check, replay in part, and merge with their own."""

from vlagents_ray.evaluate.bundle.archive import write_bundle
from vlagents_ray.evaluate.bundle.verification import Finding, Verification, verify

__all__ = ["Finding", "Verification", "verify", "write_bundle"]
