"""Check Kubernetes manifests against their schemas, without Kubernetes.

The package kubernetes-validate contains the schemas of the core kinds and of pods inside KubeRay's
kinds. No package index has KubeRay's own schemas. The models below have the keys that the manifests
use, taken from the custom resource definitions of KubeRay 1.6.2 and 1.7.0. Any other key, such as a
misspelt one, is an error. The same is true for the kind of Prometheus' operator.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any, Literal

import kubernetes_validate
import yaml
from eval_fakes import wait_for
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator
from pydantic.alias_generators import to_camel
from simulated_hosts import RayCluster

FOLDER = Path(__file__).parents[2] / "cluster" / "kuberay"
KUBERNETES = "1.37"


def _pod(template: dict[str, Any]) -> dict[str, Any]:
    pod = {"apiVersion": "v1", "kind": "Pod", "metadata": {"name": "of-a-template"}, **template}
    kubernetes_validate.validate(pod, KUBERNETES, strict=True)
    return template


def _container(part: dict[str, Any]) -> dict[str, Any]:
    _pod({"spec": {"containers": [part]}})
    return part


PodTemplate = Annotated[dict[str, Any], AfterValidator(_pod)]
RayStartParams = dict[str, str]  # options of `ray start`, without their dashes


class _Closed(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, alias_generator=to_camel)


class AuthOptions(_Closed):
    mode: Literal["disabled", "token"]


class AutoscalerOptions(_Closed):
    version: Literal["v1", "v2"]
    upscaling_mode: Literal["Default", "Aggressive", "Conservative"]
    idle_timeout_seconds: int = Field(ge=0)
    resources: dict[str, Any]
    security_context: dict[str, Any]
    volume_mounts: list[dict[str, Any]]

    @property
    def container(self) -> dict[str, Any]:
        """Return the container that KubeRay adds to the head's pod."""
        return {
            "name": "autoscaler",
            "resources": self.resources,
            "securityContext": self.security_context,
            "volumeMounts": self.volume_mounts,
        }

    @model_validator(mode="after")
    def _as_of_a_container(self) -> AutoscalerOptions:
        _container(self.container)
        return self


class HeadGroup(_Closed):
    ray_start_params: RayStartParams
    template: PodTemplate


class WorkerGroup(HeadGroup):
    group_name: str
    replicas: int = Field(ge=0)
    min_replicas: int = Field(ge=0)
    max_replicas: int = Field(ge=1)
    idle_timeout_seconds: int = Field(default=60, ge=0)

    @model_validator(mode="after")
    def _ordered(self) -> WorkerGroup:
        if not self.min_replicas <= self.replicas <= self.max_replicas:
            raise ValueError(
                f"{self.group_name}: {self.min_replicas} <= {self.replicas} <= {self.max_replicas} "
                "is false"
            )
        return self


class ClusterSpec(_Closed):
    ray_version: str  # authOptions requires this key, and at least 2.52
    auth_options: AuthOptions
    enable_in_tree_autoscaling: Literal[True]
    autoscaler_options: AutoscalerOptions
    head_group_spec: HeadGroup
    worker_group_specs: list[WorkerGroup]


class UpgradeStrategy(_Closed):
    type: Literal["NewCluster", "NewClusterWithIncrementalUpgrade", "None"]


class ServiceSpec(_Closed):
    upgrade_strategy: UpgradeStrategy
    ray_cluster_deletion_delay_seconds: int = Field(ge=0)
    serve_config_v2: str
    ray_cluster_config: ClusterSpec


class SubmitterConfig(_Closed):
    backoff_limit: int = Field(ge=0)


class JobSpec(_Closed):
    entrypoint: str
    backoff_limit: int = Field(ge=0)
    shutdown_after_job_finishes: bool
    ttl_seconds_after_finished: int = Field(ge=0)
    active_deadline_seconds: int = Field(gt=0)
    submitter_config: SubmitterConfig
    submitter_pod_template: PodTemplate
    ray_cluster_spec: ClusterSpec


class Metadata(_Closed):
    # KubeRay derives longer names from this name.
    name: str = Field(max_length=47, pattern=r"[a-z]([-a-z0-9]*[a-z0-9])?")


class RayService(_Closed):
    api_version: Literal["ray.io/v1"]
    kind: Literal["RayService"]
    metadata: Metadata
    spec: ServiceSpec

    @property
    def cluster(self) -> ClusterSpec:
        return self.spec.ray_cluster_config


class RayJob(_Closed):
    api_version: Literal["ray.io/v1"]
    kind: Literal["RayJob"]
    metadata: Metadata
    spec: JobSpec

    @property
    def cluster(self) -> ClusterSpec:
        return self.spec.ray_cluster_spec


class PodSelector(_Closed):
    match_labels: dict[str, str]


class MetricsEndpoint(_Closed):
    port: str
    interval: str


class MonitorSpec(_Closed):
    selector: PodSelector
    pod_metrics_endpoints: list[MetricsEndpoint]


class PodMonitor(_Closed):
    """A PodMonitor of Prometheus' operator."""

    api_version: Literal["monitoring.coreos.com/v1"]
    kind: Literal["PodMonitor"]
    metadata: Metadata
    spec: MonitorSpec


def documents(file: Path) -> list[dict[str, Any]]:
    """Return the manifests in a file."""
    return [one for one in yaml.safe_load_all(file.read_text()) if one is not None]


def manifest(kind: str, name: str) -> dict[str, Any]:
    """Return the manifest of this kind and name in cluster/kuberay."""
    found = [one for file in sorted(FOLDER.glob("*.yaml")) for one in documents(file)]
    [it] = [one for one in found if one["kind"] == kind and one["metadata"]["name"] == name]
    return it


def check(document: dict[str, Any]) -> None:
    """Raise the validation error of pydantic or of kubernetes-validate if a manifest is invalid."""
    ours = {"RayService": RayService, "RayJob": RayJob, "PodMonitor": PodMonitor}
    if document["kind"] in ours:
        ours[document["kind"]].model_validate(document)
    else:
        kubernetes_validate.validate(document, KUBERNETES, strict=True)


STATUS = """
import json, ray
from ray import serve
ray.init(logging_level="ERROR")
print(json.dumps({name: [app.status, app.message] for name, app in serve.status().applications.items()}))
"""


def serve_runs(cluster: RayCluster) -> None:
    """Wait until all applications of a cluster run; raise `AssertionError` if one fails."""

    def runs() -> bool:
        states = json.loads(cluster.python(STATUS).splitlines()[-1])
        failed = {
            name: state
            for name, state in states.items()
            if state[0] in ("DEPLOY_FAILED", "UNHEALTHY")
        }
        assert not failed, failed
        return bool(states) and all(state == "RUNNING" for state, _ in states.values())

    wait_for(runs)
