"""The profile `restricted` of Kubernetes' Pod Security Standards as of Kubernetes 1.37, for pods that run Linux.

Written after the tables of https://kubernetes.io/docs/concepts/security/pod-security-standards/, the profile
`baseline`, which it contains, included. A field that is not there is allowed or not as the tables say.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

VOLUMES = {
    "configMap",
    "csi",
    "downwardAPI",
    "emptyDir",
    "ephemeral",
    "image",
    "persistentVolumeClaim",
    "projected",
    "secret",
}
SYSCTLS = {
    "kernel.shm_rmid_forced",
    "net.ipv4.ip_local_port_range",
    "net.ipv4.ip_unprivileged_port_start",
    "net.ipv4.tcp_syncookies",
    "net.ipv4.ping_group_range",
    "net.ipv4.ip_local_reserved_ports",
    "net.ipv4.tcp_keepalive_time",
    "net.ipv4.tcp_fin_timeout",
    "net.ipv4.tcp_keepalive_intvl",
    "net.ipv4.tcp_keepalive_probes",
    "net.ipv4.tcp_notsent_lowat",
    "net.ipv4.tcp_rmem",
    "net.ipv4.tcp_slow_start_after_idle",
    "net.ipv4.tcp_wmem",
}
SELINUX_TYPES = {None, "", "container_t", "container_init_t", "container_kvm_t", "container_engine_t"}


def forbidden(spec: dict[str, Any]) -> list[str]:
    """What of a pod's `spec` the profile does not allow, each with its field; nothing if the pod is let in."""
    return sorted(set(_of_pod(spec)) | {found for one in _containers(spec) for found in _of_container(spec, one)})


def _containers(spec: dict[str, Any]) -> list[dict[str, Any]]:
    return [one for kind in ("initContainers", "containers", "ephemeralContainers") for one in spec.get(kind, [])]


def _of_pod(spec: dict[str, Any]) -> Iterator[str]:
    security = spec.get("securityContext", {})
    for field in ("hostNetwork", "hostPID", "hostIPC"):
        if spec.get(field):
            yield field
    for volume in spec.get("volumes", []):
        if not set(volume) - {"name"} <= VOLUMES:
            yield f"volumes: {volume['name']}"
    for sysctl in security.get("sysctls", []):
        if sysctl["name"] not in SYSCTLS:
            yield f"sysctls: {sysctl['name']}"
    if security.get("runAsUser") == 0:
        yield "runAsUser"
    yield from _of_any(security)


def _of_container(spec: dict[str, Any], container: dict[str, Any]) -> Iterator[str]:
    name = container["name"]
    security = container.get("securityContext", {})
    merged = spec.get("securityContext", {}) | security  # a container's own settings go before its pod's
    capabilities = security.get("capabilities", {})
    found = {
        "privileged": security.get("privileged", False),
        "allowPrivilegeEscalation": security.get("allowPrivilegeEscalation") is not False,
        "capabilities.drop": "ALL" not in capabilities.get("drop", []),
        "capabilities.add": not set(capabilities.get("add", [])) <= {"NET_BIND_SERVICE"},
        "procMount": security.get("procMount", "Default") != "Default",
        "runAsNonRoot": merged.get("runAsNonRoot") is not True,
        "runAsUser": merged.get("runAsUser") == 0,
        "seccompProfile": merged.get("seccompProfile", {}).get("type") not in ("RuntimeDefault", "Localhost"),
        "hostPort": any(port.get("hostPort") for port in container.get("ports", [])),
        "host": any(_asks_a_host(container, hook) for hook in ("livenessProbe", "readinessProbe", "startupProbe"))
        or any(_asks_a_host(container.get("lifecycle", {}), hook) for hook in ("postStart", "preStop")),
    }
    yield from (f"{name}: {field}" for field, is_so in found.items() if is_so)
    yield from (f"{name}: {field}" for field in _of_any(security))


def _of_any(security: dict[str, Any]) -> Iterator[str]:
    """What neither a pod's nor a container's `securityContext` may say."""
    selinux = security.get("seLinuxOptions", {})
    if selinux.get("type") not in SELINUX_TYPES or selinux.get("user") or selinux.get("role"):
        yield "seLinuxOptions"
    if security.get("appArmorProfile", {}).get("type", "RuntimeDefault") not in ("RuntimeDefault", "Localhost"):
        yield "appArmorProfile"
    if security.get("windowsOptions", {}).get("hostProcess"):
        yield "hostProcess"


def _asks_a_host(hooks: dict[str, Any], hook: str) -> bool:
    return any(hooks.get(hook, {}).get(how, {}).get("host") for how in ("httpGet", "tcpSocket"))
