"""Manifests of Kubernetes, without Kubernetes: they keep the schemas, agree with each other, and open nothing."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import yaml

from surrogym_server.settings import read_settings

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "docker" / "kubernetes"
SCHEMAS: dict[str, Any] = json.loads((Path(__file__).parent / "schemas" / "kubernetes.json").read_text())
KUSTOMIZATION: dict[str, Any] = yaml.safe_load((FOLDER / "kustomization.yaml").read_text())
OBJECTS: dict[str, dict[str, Any]] = {
    f"{one['kind']} {one['metadata']['name']}": one
    for file in KUSTOMIZATION["resources"]
    for one in yaml.safe_load_all((FOLDER / file).read_text())
}
FRONT = OBJECTS["Deployment front"]["spec"]["template"]
CLUSTER = OBJECTS["RayCluster surrogym"]["spec"]
PODS = {
    "front": FRONT,
    "head": CLUSTER["headGroupSpec"]["template"],
    "node": CLUSTER["workerGroupSpecs"][0]["template"],
}
SERVER = FRONT["spec"]["containers"][0]
SECRET = dict(line.split("=", 1) for line in (FOLDER / "secrets.example.env").read_text(encoding="utf-8").splitlines())


def problems(manifest: dict[str, Any]) -> list[str]:
    """What a manifest has against its schema."""
    name = SCHEMAS["kinds"][manifest["kind"]]
    schema = {"$ref": f"#/definitions/{name}", "definitions": SCHEMAS["definitions"]}
    return [error.message for error in jsonschema.Draft202012Validator(schema).iter_errors(manifest)]


@pytest.mark.parametrize("name", OBJECTS)
def test_every_kubernetes_manifest_matches_its_schema(name: str) -> None:
    assert problems(OBJECTS[name]) == []


@pytest.mark.parametrize("name", OBJECTS)
def test_the_schema_check_finds_a_misspelt_field_of_a_manifest(name: str) -> None:
    assert problems({**OBJECTS[name], "specs": {}})


def test_the_schema_check_finds_a_misspelt_field_of_a_pod() -> None:
    for kind, spec in (("Deployment", {"template": {**FRONT, "spek": 1}, "selector": {}}), ("RayCluster", {**CLUSTER})):
        wrong = {"apiVersion": OBJECTS_OF[kind]["apiVersion"], "kind": kind, "metadata": {"name": "x"}, "spec": spec}
        if kind == "RayCluster":
            spec["headGroupSpec"] = {"template": {**PODS["head"], "spek": 1}}
        assert any("spek" in problem for problem in problems(wrong))


OBJECTS_OF = {one["kind"]: one for one in OBJECTS.values()}


def test_every_kubernetes_manifest_is_listed_in_the_kustomization() -> None:
    applied = {*KUSTOMIZATION["resources"], "kustomization.yaml"}
    assert {path.name for path in FOLDER.glob("*.yaml")} == applied


def test_the_kubernetes_secret_has_the_keys_the_pods_read_and_is_not_versioned() -> None:
    assert KUSTOMIZATION["secretGenerator"] == [{"name": "surrogym", "envs": ["secrets.env"]}]
    asked = {one["valueFrom"]["secretKeyRef"]["key"] for one in SERVER["env"] if "valueFrom" in one}
    assert asked == set(SECRET)
    assert CLUSTER["authOptions"] == {"mode": "token", "secretName": "surrogym"}
    assert "auth_token" in SECRET
    assert "docker/kubernetes/secrets.env" in (ROOT / ".gitignore").read_text(encoding="utf-8").splitlines()
    assert not (FOLDER / "secrets.env").exists() or "CHANGE-ME" not in (FOLDER / "secrets.env").read_text()


def test_the_kubernetes_front_server_accepts_its_environment_variables() -> None:
    given = {
        one["name"]: one.get("value", SECRET.get(one.get("valueFrom", {}).get("secretKeyRef", {}).get("key"), ""))
        for one in SERVER["env"]
    }
    given = {name: value.replace("CHANGE-ME", "0123456789abcdef") for name, value in given.items()}
    tokens = {"SURROGYM_TOKENS": "admin:0123456789abcdef"}
    settings = read_settings({name: value for name, value in (given | tokens).items() if name.startswith("SURROGYM_")})
    assert (settings.host, settings.port) == ("0.0.0.0", SERVER["ports"][0]["containerPort"])
    room = CLUSTER["workerGroupSpecs"][0]
    cpus = room["minReplicas"] * int(room["template"]["spec"]["containers"][0]["resources"]["limits"]["cpu"])
    assert settings.ray_hosts + settings.fit_workers <= cpus


def test_kubernetes_front_servers_use_the_ray_head_name_of_kuberay() -> None:
    head = next(one["value"] for one in SERVER["env"] if one["name"] == "RAY_HEAD")
    assert head == f"{OBJECTS['RayCluster surrogym']['metadata']['name']}-head-svc:6379"


def test_the_kubernetes_ray_version_is_that_of_the_image() -> None:
    pinned = re.search(r"^ray==(\S+)", (ROOT / "constraints.txt").read_text(encoding="utf-8"), re.MULTILINE)
    assert pinned is not None
    assert CLUSTER["rayVersion"] == pinned[1]


def test_kubernetes_session_hosts_run_without_lowered_cpu_priority() -> None:
    [container] = PODS["node"]["spec"]["containers"]
    assert {"name": "RAY_worker_niceness", "value": "0"} in container["env"]


def test_kubernetes_liveness_and_readiness_probes_use_separate_routes() -> None:
    assert SERVER["livenessProbe"]["httpGet"]["path"] == SERVER["startupProbe"]["httpGet"]["path"] == "/healthz"
    assert SERVER["readinessProbe"]["httpGet"]["path"] == "/readyz"
    for pod in PODS.values():
        (container,) = pod["spec"]["containers"]
        assert {"livenessProbe", "readinessProbe"} <= container.keys()


def test_service_ingress_and_autoscaler_select_the_front_servers() -> None:
    service = OBJECTS["Service front"]["spec"]
    assert service["selector"].items() <= FRONT["metadata"]["labels"].items()
    assert service["ports"][0]["targetPort"] == SERVER["ports"][0]["name"]
    ingress = OBJECTS["Ingress surrogym"]["spec"]
    backend = ingress["rules"][0]["http"]["paths"][0]["backend"]["service"]
    assert (backend["name"], backend["port"]["name"]) == ("front", service["ports"][0]["name"])
    assert ingress["tls"][0]["hosts"] == [ingress["rules"][0]["host"]]
    scaled = OBJECTS["HorizontalPodAutoscaler front"]["spec"]
    assert scaled["scaleTargetRef"]["name"] == "front"
    assert "replicas" not in OBJECTS["Deployment front"]["spec"]
    assert OBJECTS["PodDisruptionBudget front"]["spec"]["minAvailable"] < scaled["minReplicas"]


@pytest.mark.parametrize("name", PODS)
def test_no_kubernetes_pod_runs_as_root_or_exposes_ray_ports(name: str) -> None:
    pod = PODS[name]
    assert (pod["spec"]["securityContext"]["runAsNonRoot"], pod["spec"]["securityContext"]["runAsUser"]) == (True, 1000)
    assert all(
        container["securityContext"] == {"allowPrivilegeEscalation": False, "capabilities": {"drop": ["ALL"]}}
        for container in pod["spec"]["containers"]
    )
    closed = OBJECTS["NetworkPolicy ray"]["spec"]["podSelector"]["matchLabels"]
    assert closed.items() <= pod["metadata"]["labels"].items()
    assert [one["image"] for one in pod["spec"]["containers"]] == [KUSTOMIZATION["images"][0]["name"]]
