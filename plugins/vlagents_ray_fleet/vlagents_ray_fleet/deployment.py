"""The deployment file of a plan, for `vlagents-ray serve`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from vlagents_ray.errors import ConfigError
from vlagents_ray.serve.launch.deployment_file import (
    IMPORT_PATH,
    policy_application,
    read_deployment,
)
from vlagents_ray_fleet.fleet_file import FleetFile, FleetModel
from vlagents_ray_fleet.plan import FleetPlan, ModelPlan


def deployment_document(fleet: FleetFile, plan: FleetPlan, folder: Path) -> dict[str, Any]:
    """Return the deployment of a plan, one application for each model.

    Args:
        fleet: The file of the fleet.
        plan: The plan of the fleet.
        folder: The folder to which the names of deployment files in the fleet's file are relative.

    Raises:
        ConfigError: A model has no policy, or its deployment file cannot be read.
    """
    is_only = len(plan.models) == 1
    applications = []
    for model in plan.models:
        applications.append(
            {
                "name": model.model,
                "route_prefix": "/" if is_only else f"/{model.model}",
                "import_path": IMPORT_PATH,
                "args": _arguments(fleet.models[model.model], model, folder),
            }
        )
    return {"applications": applications}


def write_deployment(document: dict[str, Any], file: Path, source: str) -> None:
    """Write a deployment file, and check it.

    Args:
        document: The deployment.
        file: The file to write.
        source: The name of the file of the fleet, for the comment at the top.

    Raises:
        ConfigError: The suffix of the file is neither .yaml nor .yml, or a setting is wrong.
    """
    if file.suffix not in (".yaml", ".yml"):
        raise ConfigError(f"--out: expected a YAML file (.yaml), got {str(file)!r}")
    text = yaml.safe_dump(document, sort_keys=False)
    file.write_text(f"# Written by `vlagents-ray plan {source}`.\n{text}")
    read_deployment(str(file))


def _arguments(model: FleetModel, plan: ModelPlan, folder: Path) -> dict[str, Any]:
    """Return the settings of a model's application."""
    if model.deployment is not None:
        application = policy_application(str(folder / model.deployment))
        arguments = dict(application.args)
    elif model.policy is not None:
        arguments = {"policy": model.policy}
        if model.config:
            arguments["config"] = model.config
    else:
        raise ConfigError(
            f"models.{plan.model}: expected `deployment` or `policy` for --out, got neither; "
            f"write `deployment: deployments/{plan.model}.yaml`"
        )

    # The plan determines these settings, whatever the deployment file for a single robot contains.
    arguments.pop("autoscaling", None)
    batch = {"max_size": plan.batch_size}
    patience = (arguments.get("batch") or {}).get("patience")
    if patience is not None:
        batch["patience"] = patience
    resources = dict(arguments.get("resources") or {})
    return arguments | {
        "replicas": plan.replicas,
        "batch": batch,
        "resources": resources | {"num_gpus": plan.gpu_fraction},
    }
