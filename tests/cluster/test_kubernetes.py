"""The manifests in cluster/kuberay: they are valid and consistent with each other, and their server
starts.
"""

from __future__ import annotations

import copy
import ipaddress
import json
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import kubernetes_validate
import pytest
import yaml
from kuberay import FOLDER, PodMonitor, RayJob, RayService, check, documents, manifest, serve_runs
from packaging.specifiers import SpecifierSet
from pydantic import ValidationError
from readme_blocks import check_command
from simulated_hosts import HostFailed, hosts, ray_cluster
from typer.testing import CliRunner

from vlagents_ray.cli.main import app
from vlagents_ray.evaluate import EvalConfig
from vlagents_ray.serve.access.key_store import new_key
from vlagents_ray.serve.access.variables import FILE_VARIABLE
from vlagents_ray.serve.config.deployment import ServerArgs
from vlagents_ray.serve.launch.deployment_file import read_deployment
from vlagents_ray.serve.launch.haproxy import ROBOTS

pytestmark = pytest.mark.integration

ROOT = Path(__file__).parents[2]
DOCKERFILE = (ROOT / "cluster/docker/Dockerfile").read_text()
SERVICE = RayService.model_validate(manifest("RayService", "policy"))
JOB = RayJob.model_validate(manifest("RayJob", "evaluation"))
PODS = {
    "policy-head": SERVICE.cluster.head_group_spec.template,
    **{
        f"policy-{group.group_name}": group.template for group in SERVICE.cluster.worker_group_specs
    },
    "evaluation-head": JOB.cluster.head_group_spec.template,
    **{
        f"evaluation-{group.group_name}": group.template for group in JOB.cluster.worker_group_specs
    },
    "evaluation-submitter": JOB.spec.submitter_pod_template,
    "reader": manifest("Pod", "results-reader"),
}
# The requirements for each container in
# https://kubernetes.io/docs/concepts/security/pod-security-standards/, `restricted`, and a
# read-only root.
CONTAINER = {
    "allowPrivilegeEscalation": False,
    "capabilities": {"drop": ["ALL"]},
    "readOnlyRootFilesystem": True,
}
RAY_PODS = {
    name: pod for name, pod in PODS.items() if name not in ("evaluation-submitter", "reader")
}
ROBOT = """
import sys
from vlagents_ray import RemoteAgent, Unauthorized
from vlagents_ray.envs import make_env

url, key = sys.argv[1:]
env = make_env("tabletop")
obs, info = env.reset(seed=0)
try:
    with RemoteAgent(url, api_key="vlr_wrong") as agent:
        agent.reset(obs, env.instruction, env="tabletop")
    sys.exit("a wrong key was let in")
except Unauthorized:
    pass
with RemoteAgent(url, api_key=key) as agent:
    agent.reset(obs, env.instruction, env="tabletop")
    for _ in range(20):
        obs, *_ = env.step(agent.act(obs))
    print(agent.transport, agent.metadata["policy"])
"""


def values_of(document: Any, key: str) -> list[Any]:
    """Yield the values of every `key` in a manifest, at any depth."""
    if isinstance(document, list):
        return [value for one in document for value in values_of(one, key)]
    if not isinstance(document, dict):
        return []
    return [
        value
        for name, one in document.items()
        for value in ([one] if name == key else values_of(one, key))
    ]


@pytest.mark.parametrize("file", sorted(FOLDER.glob("*.yaml")), ids=lambda file: file.stem)
def test_a_manifest_is_as_its_schema_wants_it(file: Path) -> None:
    assert documents(file)
    for document in documents(file):
        check(document)


@pytest.mark.parametrize("where", ["cluster", "group", "pod", "container", "autoscaler"])
def test_a_misspelt_key_is_found(where: str) -> None:
    document = copy.deepcopy(manifest("RayService", "policy"))
    cluster = document["spec"]["rayClusterConfig"]
    pod = cluster["headGroupSpec"]["template"]["spec"]
    places = {
        "cluster": cluster,
        "group": cluster["workerGroupSpecs"][0],
        "pod": pod,
        "container": pod["containers"][0],
        "autoscaler": cluster["autoscalerOptions"]["resources"],
    }
    places[where]["mispelt"] = 1
    with pytest.raises((ValidationError, kubernetes_validate.ValidationError), match="mispelt"):
        check(document)


def test_the_embedded_deployment_is_one_that_serve_takes(tmp_path: Path) -> None:
    file = tmp_path / "service.yaml"
    file.write_text(SERVICE.spec.serve_config_v2)
    config = read_deployment(str(file))
    [port] = [
        port["containerPort"]
        for port in SERVICE.cluster.head_group_spec.template["spec"]["containers"][0]["ports"]
        if port["name"] == "serve"
    ]
    assert (config.http_options.host, config.http_options.port) == ("0.0.0.0", port)  # noqa: S104 - an address in a pod
    [application] = config.applications
    args = ServerArgs(**application.args)
    assert args.autoscaling is not None
    cpu = next(group for group in SERVICE.cluster.worker_group_specs if group.group_name == "cpu")
    room = (
        int(cpu.template["spec"]["containers"][0]["resources"]["limits"]["cpu"])
        // args.resources.num_cpus
    )
    assert args.autoscaling.max_replicas <= cpu.max_replicas * room


@pytest.mark.ray
def test_the_run_file_and_the_entrypoint_are_ones_that_eval_takes(tmp_path: Path) -> None:
    run = manifest("ConfigMap", "evaluation-run")["data"]["run.yaml"]
    config = EvalConfig.model_validate(yaml.safe_load(run) | {"out": "runs/x"})
    [cpu] = [group for group in JOB.cluster.worker_group_specs if group.group_name == "cpu"]
    room = cpu.max_replicas * float(
        cpu.template["spec"]["containers"][0]["resources"]["limits"]["cpu"]
    )
    assert 1 <= config.worker.cpus <= room / config.workers
    name, *words = shlex.split(JOB.spec.entrypoint)
    assert name == "vlagents-ray"
    (tmp_path / "run.yaml").write_text(run)
    here = [
        str(tmp_path / "run.yaml") if word == "/etc/vlagents/run/run.yaml" else word
        for word in words
    ]
    result = CliRunner().invoke(app, [*here, "--dry-run"])
    assert result.exit_code == 0, result.output


def test_pods_find_the_settings_that_a_server_of_our_own_gives_haproxy() -> None:
    settings = manifest("ConfigMap", "policy-settings")["data"]
    assert {name: settings[name] for name in ROBOTS} == ROBOTS
    for name, pod in RAY_PODS.items():
        if name.startswith("policy-"):
            [container] = pod["spec"]["containers"]
            assert container["envFrom"] == [{"configMapRef": {"name": "policy-settings"}}]
            [mount] = [one for one in container["volumeMounts"] if one["name"] == "keys"]
            assert settings[FILE_VARIABLE] == f"{mount['mountPath']}/keys.json"


def complete(name: str) -> dict[str, Any]:
    """Return the spec of a pod, including the container that KubeRay adds to a head."""
    spec = copy.deepcopy(PODS[name]["spec"])
    if name.endswith("-head"):
        cluster = (SERVICE if name.startswith("policy") else JOB).cluster
        spec["containers"].append(cluster.autoscaler_options.container)
    return spec


@pytest.mark.parametrize("name", PODS)
def test_a_pod_is_one_that_the_profile_restricted_lets_in(name: str) -> None:
    user = re.search(r"^USER (\d+):(\d+)$", DOCKERFILE, re.MULTILINE)
    assert user is not None
    spec = complete(name)
    assert spec["securityContext"] == {
        "runAsNonRoot": True,
        "runAsUser": int(user[1]),
        "runAsGroup": int(user[2]),
        "fsGroup": int(user[2]),
        "seccompProfile": {"type": "RuntimeDefault"},
    }
    for container in [*spec["containers"], *spec.get("initContainers", [])]:
        assert container["securityContext"] == CONTAINER, container["name"]
    kinds = {kind for volume in spec["volumes"] for kind in volume if kind != "name"}
    assert kinds <= {"configMap", "emptyDir", "persistentVolumeClaim", "projected", "secret"}
    for field in ("hostNetwork", "hostPID", "hostIPC", "hostPort", "host", "ephemeralContainers"):
        assert values_of(spec, field) == [], field


@pytest.mark.parametrize("name", PODS)
def test_a_pod_gets_what_it_asks_for(name: str) -> None:
    for container in PODS[name]["spec"]["containers"]:
        assert container["resources"]["requests"] == container["resources"]["limits"]


@pytest.mark.parametrize("name", PODS)
def test_a_pod_writes_where_the_image_says(name: str) -> None:
    [volumes] = re.findall(r"^VOLUME (.*)$", DOCKERFILE, re.MULTILINE)
    spec = complete(name)
    kinds = {
        volume["name"]: next(key for key in volume if key != "name") for volume in spec["volumes"]
    }
    for container in spec["containers"]:
        mounts = {mount["mountPath"]: mount for mount in container["volumeMounts"]}
        written = {path for path, mount in mounts.items() if kinds[mount["name"]] == "emptyDir"}
        assert written <= {*json.loads(volumes), "/dev/shm"}
        if container["name"] in ("ray-head", "ray-worker"):
            assert written == {"/tmp", "/home/robot", "/dev/shm"}


@pytest.mark.parametrize("name", PODS)
def test_a_pod_with_a_gpu_keeps_its_programs_for_the_next_one(name: str) -> None:
    spec = PODS[name]["spec"]
    kept = [one for one in spec["volumes"] if "persistentVolumeClaim" in one]
    claims = {one["name"]: one["persistentVolumeClaim"]["claimName"] for one in kept}
    for container in spec["containers"]:
        mounts = {one["mountPath"]: claims.get(one["name"]) for one in container["volumeMounts"]}
        cache = {one["name"]: one["value"] for one in container.get("env", [])}.get(
            "XDG_CACHE_HOME", ""
        )
        assert (mounts.get(cache) == "cache") is (
            "nvidia.com/gpu" in container["resources"]["limits"]
        )
        # The parents of a mount below a volume would belong to root.
        assert not [path for path in mounts for other in mounts if path.startswith(f"{other}/")]
    assert manifest("PersistentVolumeClaim", "cache")["spec"]["accessModes"] == ["ReadWriteMany"]


@pytest.mark.parametrize("name", PODS)
def test_the_autoscaler_alone_may_ask_kubernetes(name: str) -> None:
    spec = complete(name)
    assert spec["automountServiceAccountToken"] is False
    with_token = {
        container["name"]
        for container in spec["containers"]
        for mount in container["volumeMounts"]
        if mount["mountPath"] == "/var/run/secrets/kubernetes.io/serviceaccount"
    }
    assert with_token == ({"autoscaler"} if name.endswith("-head") else set())


def labels_of(name: str) -> dict[str, str]:
    """Return the labels of a pod, including the one that KubeRay adds."""
    kind = (
        {"ray.io/node-type": "head" if name.endswith("-head") else "worker"}
        if name in RAY_PODS
        else {}
    )
    return PODS[name]["metadata"]["labels"] | kind


def selected(selector: dict[str, Any]) -> set[str]:
    """Return the pods that a label selector matches."""
    return {
        name
        for name in PODS
        if selector.get("matchLabels", {}).items() <= labels_of(name).items()
        and all(
            labels_of(name).get(one["key"]) in one["values"]
            for one in selector.get("matchExpressions", [])
        )
    }


def test_a_budget_keeps_the_heads_and_the_last_worker_that_serves() -> None:
    budgets = {
        one["metadata"]["name"]: one["spec"] for one in documents(FOLDER / "disruption.yaml")
    }
    assert {name: selected(spec["selector"]) for name, spec in budgets.items()} == {
        "policy-head": {"policy-head"},
        "policy-workers": {"policy-cpu", "policy-gpu"},
        "evaluation-head": {"evaluation-head"},
    }
    # For pods whose owner has no scale, Kubernetes accepts only a number.
    for spec in budgets.values():
        assert spec["minAvailable"] == 1
        assert "maxUnavailable" not in spec


def leaves(name: str) -> list[dict[str, Any]]:
    """Return the rules of all policies that allow a pod's outgoing connections."""
    policies = [one["spec"] for one in documents(FOLDER / "network.yaml")]
    mine = [
        spec
        for spec in policies
        if name in selected(spec["podSelector"]) and "Egress" in spec["policyTypes"]
    ]
    assert mine, f"{name} can reach everything"
    return [rule for spec in mine for rule in spec["egress"]]


def reaches(name: str, address: str, port: int) -> bool:
    """Return whether a pod may connect over TCP to an address outside of the cluster's pods."""
    wanted = ipaddress.ip_address(address)
    for rule in leaves(name):
        blocks = [to["ipBlock"] for to in rule.get("to", []) if "ipBlock" in to]
        inside = "to" not in rule or any(
            wanted in ipaddress.ip_network(block["cidr"])
            and not any(wanted in ipaddress.ip_network(one) for one in block.get("except", []))
            for block in blocks
        )
        ports = rule.get("ports", [{"protocol": "TCP", "port": port}])
        if inside and {"protocol": "TCP", "port": port} in ports:
            return True
    return False


@pytest.mark.parametrize("name", PODS)
def test_a_pod_reaches_its_own_names_and_public_weights_and_no_private_network(name: str) -> None:
    assert reaches(name, "8.8.8.8", 443)
    assert reaches(name, "2600::1", 443)
    assert not reaches(name, "8.8.8.8", 80)
    for private in ("10.0.0.1", "172.16.0.1", "192.168.0.1", "169.254.169.254", "fd00::1"):
        # The autoscaler needs the Kubernetes API.
        assert reaches(name, private, 443) is name.endswith("-head"), private
        assert not reaches(name, private, 80), private
    to = [one for rule in leaves(name) for one in rule.get("to", [])]
    others = {
        pod
        for one in to
        if "namespaceSelector" not in one
        for pod in selected(one.get("podSelector") or {"matchLabels": {"": ""}})
    }
    own = {
        pod
        for pod in PODS
        if labels_of(pod)["vlagents-ray/cluster"] == labels_of(name)["vlagents-ray/cluster"]
    }
    assert others == (own if name.startswith("policy") else set(PODS))
    assert {"protocol": "UDP", "port": 53} in [
        port for rule in leaves(name) for port in rule.get("ports", [])
    ]


def test_the_namespace_has_kubernetes_hold_pods_to_the_profile() -> None:
    labels = manifest("Namespace", "robots")["metadata"]["labels"]
    assert labels["pod-security.kubernetes.io/enforce"] == "restricted"


@pytest.mark.parametrize("name", RAY_PODS)
def test_the_object_store_fits_into_the_pods_shared_memory(name: str) -> None:
    cluster, _, group = name.partition("-")
    spec = (SERVICE if cluster == "policy" else JOB).cluster
    groups = {"head": spec.head_group_spec} | {
        one.group_name: one for one in spec.worker_group_specs
    }
    store = int(groups[group].ray_start_params["object-store-memory"])
    [shm] = [one["emptyDir"] for one in RAY_PODS[name]["spec"]["volumes"] if one["name"] == "shm"]
    memory = RAY_PODS[name]["spec"]["containers"][0]["resources"]["limits"]["memory"]
    assert shm["medium"] == "Memory"
    assert store < gibibytes(shm["sizeLimit"]) <= gibibytes(memory) / 2


def gibibytes(quantity: str) -> int:
    return int(quantity.removesuffix("Gi")) * 2**30


def test_manifests_agree_on_names_versions_and_labels() -> None:
    everything = [one for file in FOLDER.glob("*.yaml") for one in documents(file)]
    assert set(values_of(everything, "image")) == {f"vlagents-ray:{vlagents_ray_version()}"}
    allowed = re.search(r'"ray\[serve\]([^"]+)"', (ROOT / "pyproject.toml").read_text())
    assert allowed is not None
    [ray_version] = {SERVICE.cluster.ray_version, JOB.cluster.ray_version}
    assert ray_version in SpecifierSet(allowed[1])
    for name, pod in PODS.items():
        label = pod["metadata"]["labels"]["vlagents-ray/cluster"]
        assert label == ("policy" if name.startswith("policy") else "evaluation")
        assert manifest("NetworkPolicy", label)["spec"]["podSelector"]["matchLabels"] == {
            "vlagents-ray/cluster": label
        }
    [backend] = values_of(manifest("Ingress", "policy"), "service")
    assert backend["name"] == f"{SERVICE.metadata.name}-serve-svc"  # the name that KubeRay gives it
    claims = {
        one["metadata"]["name"] for one in everything if one["kind"] == "PersistentVolumeClaim"
    }
    assert set(values_of(everything, "claimName")) == claims


def vlagents_ray_version() -> str:
    version = re.search(r'^version = "(.*)"$', (ROOT / "pyproject.toml").read_text(), re.MULTILINE)
    assert version is not None
    return version[1]


def test_the_monitor_finds_the_pods_of_the_server_and_the_network_lets_it_in() -> None:
    spec = PodMonitor.model_validate(manifest("PodMonitor", "policy")).spec
    for name in ("policy-head", "policy-cpu", "policy-gpu"):
        assert spec.selector.match_labels.items() <= PODS[name]["metadata"]["labels"].items()
    assert [endpoint.port for endpoint in spec.pod_metrics_endpoints] == ["metrics"]
    network = manifest("NetworkPolicy", "policy")
    [rule] = [one for one in network["spec"]["ingress"] if "monitoring" in str(one["from"])]
    assert 8080 in [port["port"] for port in rule["ports"]]


def test_the_page_names_files_that_exist_and_settings_that_are_taken() -> None:
    page = (ROOT / "docs/cluster/kubernetes.md").read_text()
    [args] = re.findall(r"```yaml\n(.*?)```", page, re.DOTALL)
    assert ServerArgs(**yaml.safe_load(args)).resources.num_gpus == 1
    shell = "\n".join(re.findall(r"```bash\n(.*?)```", page, re.DOTALL))
    assert subprocess.run(["bash", "-n"], input=shell, text=True, check=False).returncode == 0
    named = re.findall(r"cluster/\w+/[\w.]+", shell)
    assert {Path(name).name for name in named if name.endswith(".yaml")} <= {
        file.name for file in FOLDER.glob("*.yaml")
    }
    assert all((ROOT / name).is_file() for name in named)
    [words] = [
        shlex.split(line, comments=True)
        for line in shell.splitlines()
        if line.startswith("vlagents-ray")
    ]
    check_command(words, "kubernetes.md")


@pytest.mark.hosts
@pytest.mark.slow
def test_the_manifests_server_comes_up_and_robots_with_a_key_play(tmp_path: Path) -> None:
    (tmp_path / "serve.yaml").write_text(SERVICE.spec.serve_config_v2)
    keys = tmp_path / "keys.json"
    key = new_key(keys, "arm")
    environment = manifest("ConfigMap", "policy-settings")["data"] | {FILE_VARIABLE: str(keys)}
    with (
        hosts(2) as [head, robot],
        ray_cluster([head], cpus=2, environment=environment, include_dashboard="true") as cluster,
    ):
        head.run(["serve", "deploy", str(tmp_path / "serve.yaml")])
        serve_runs(cluster)
        said = robot.run([sys.executable, "-c", ROBOT, f"http://{head.name}:8000", key])
        assert said.split() == ["websocket", "scripted"]
        health = (
            "import sys, urllib.request as u; print(u.urlopen(sys.argv[1], "
            "timeout=5).read().decode())"
        )
        # KubeRay's health check, which gets no answer without a key
        assert "success" in head.run(
            [sys.executable, "-c", health, "http://localhost:8000/-/healthz"]
        )
        with pytest.raises(HostFailed, match="401"):
            robot.run([sys.executable, "-c", health, f"http://{head.name}:8000/v1/metadata"])
