"""An evaluation in one file, for others to cite, to check, to play again in part, and to pool with their own."""

from vlagents_ray.evaluate.bundle.archive import write_bundle
from vlagents_ray.evaluate.bundle.verification import Finding, Verification, verify

__all__ = ["Finding", "Verification", "verify", "write_bundle"]
