"""The entries that this distribution registers, one for each command."""

from vlagents_ray.registry import RegistryEntry

MERGE = RegistryEntry(
    "vlagents_ray_results.commands:merge_command",
    "Merge results, so that each episode occurs once.",
    examples=(
        "merge runs/a runs/b --out runs/all",
        "merge runs/node-* --out runs/all --keep-first",
    ),
)
BUNDLE = RegistryEntry(
    "vlagents_ray_results.commands:bundle_command",
    "Write an evaluation as one file that others can reproduce.",
    examples=("bundle runs/first", "bundle runs/first --videos --out first.zip"),
)
VERIFY = RegistryEntry(
    "vlagents_ray_results.commands:verify_command",
    "Execute the actions of a bundle, and print the reproduced rates.",
    examples=("verify first.bundle.zip", "verify first.bundle.zip --replay 10 --out runs/check"),
)
