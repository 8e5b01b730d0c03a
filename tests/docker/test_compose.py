"""Compose file and Dockerfile, without a container engine: nothing runs as root, nothing is open, commands exist."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
import yaml

from support.commands import parse

ROOT = Path(__file__).parents[2]
COMPOSE = ROOT / "docker" / "compose.yaml"
DOCKERFILE = (ROOT / "docker" / "Dockerfile").read_text(encoding="utf-8")
SERVICES: dict[str, dict[str, Any]] = yaml.safe_load(COMPOSE.read_text(encoding="utf-8"))["services"]
BUILT = {name: service for name, service in SERVICES.items() if "build" in service}
ADDED = {name: service for name, service in SERVICES.items() if "build" not in service}
SEARCHED = f"{os.environ.get('PATH', '')}:/usr/sbin"  # where Debian has it
CLIENTS = ("register", "sampler", "trainer")
CLUSTER = ("ray-head", "ray-node", "front")
DEFAULT = re.compile(r"\$\{\w+:-([^}]*)\}")


def stages() -> dict[str, tuple[str, list[str]]]:
    """Each stage of the Dockerfile: what it is built from, and its lines."""
    found: dict[str, tuple[str, list[str]]] = {}
    lines: list[str] = []
    for line in DOCKERFILE.replace("\\\n", " ").splitlines():
        if match := re.fullmatch(r"FROM (\S+) AS (\S+)", line):
            lines = []
            found[match[2]] = (match[1], lines)
        else:
            lines.append(line)
    return found


def whole(target: str) -> list[str]:
    """All lines that lead to a target, those of the stages below it first."""
    below, lines = stages()[target]
    return [*(whole(below) if below in stages() else []), *lines]


def last(target: str, instruction: str) -> str:
    return [line.partition(" ")[2] for line in whole(target) if line.startswith(f"{instruction} ")][-1]


@pytest.mark.parametrize("target", ["server", "sampler", "trainer", "cluster"])
def test_no_container_runs_as_root(target: str) -> None:
    user = last(target, "USER")
    assert any(f"useradd --uid 1000 --create-home {user}" in line for line in whole(target))
    assert not [line for line in whole(target)[whole(target).index(f"USER {user}") :] if line.startswith("RUN ")]


def test_the_server_container_has_a_health_check() -> None:
    assert "/healthz" in last("server", "HEALTHCHECK")


def test_the_sampler_image_contains_no_torch() -> None:
    assert not [line for line in whole("sampler") if "torch" in line]


def test_the_image_installs_cpu_torch_unless_a_build_argument_selects_cuda() -> None:
    assert "ARG TORCH=cpu" in whole("torch")
    assert all(service["build"]["args"]["TORCH"] == "${TORCH:-cpu}" for service in BUILT.values())
    (choice,) = [line for line in whole("torch") if "torch.version.cuda" in line]
    assert "exit 1" in choice
    assert "set PIP_EXTRA_INDEX_URL" in choice
    assert "ARG PIP_EXTRA_INDEX_URL" in whole("torch")


def test_the_dockerfile_names_no_package_host() -> None:
    """Where packages come from is the reader's choice: pip's settings, or a build argument without a default."""
    assert re.findall(r"\w+://([\w.]+)", DOCKERFILE) == ["127.0.0.1"]
    assert all(
        service["build"]["args"]["PIP_EXTRA_INDEX_URL"] == "${PIP_EXTRA_INDEX_URL:-}" for service in BUILT.values()
    )


def test_every_image_install_is_pinned_and_keeps_no_cache() -> None:
    installs = [line for line in DOCKERFILE.splitlines() if "pip install" in line]
    assert installs
    assert all("-c constraints.txt" in line or "--no-deps" in line for line in installs)
    assert DOCKERFILE.count("PIP_NO_CACHE_DIR=1") == DOCKERFILE.count("FROM ${BASE_IMAGE}")


def test_every_path_copied_by_the_dockerfile_exists_and_is_not_ignored() -> None:
    ignored = (ROOT / ".dockerignore").read_text(encoding="utf-8").splitlines()
    copied = [line.split()[1:-1] for line in DOCKERFILE.splitlines() if line.startswith("COPY ")]
    for source in (source for sources in copied for source in sources):
        assert (ROOT / source).exists()
        assert f"!{source}" in ignored


@pytest.mark.parametrize("name", BUILT)
def test_every_compose_service_is_built_from_an_existing_dockerfile_target(name: str) -> None:
    build = SERVICES[name]["build"]
    assert (COMPOSE.parent / build["context"] / build["dockerfile"]).samefile(ROOT / "docker" / "Dockerfile")
    assert build["target"] in stages()


@pytest.mark.parametrize("name", BUILT)
def test_no_compose_service_starts_without_a_configured_token(name: str) -> None:
    tokens = {key: value for key, value in SERVICES[name]["environment"].items() if key.endswith("_TOKEN")}
    assert tokens
    assert all(value.startswith("${SURROGYM_TOKEN:?expected ") for value in tokens.values())


@pytest.mark.parametrize("name", CLIENTS)
def test_compose_clients_use_existing_commands_and_wait_for_the_server(name: str) -> None:
    values = parse([DEFAULT.sub(r"\1", word) for word in SERVICES[name]["command"]])
    assert values["wait"] >= 60
    assert SERVICES[name]["environment"]["SURROGYM_URL"] == "${SURROGYM_URL:-http://server:8000}"


def test_the_compose_server_port_is_bound_to_loopback_only() -> None:
    assert [port.startswith("127.0.0.1:") for port in SERVICES["server"]["ports"]] == [True]


def test_database_and_policies_of_the_compose_services_are_in_a_volume() -> None:
    assert "SURROGYM_DATABASE=/data/" in last("server", "ENV")
    trainer = SERVICES["trainer"]
    policy = parse([DEFAULT.sub(r"\1", word) for word in trainer["command"]])["out"]
    assert Path(policy).parent == Path("/data")
    assert SERVICES["server"]["volumes"] == trainer["volumes"] == ["data:/data"]


def test_the_compose_sampler_service_can_be_scaled() -> None:
    assert not {"container_name", "ports"} & SERVICES["sampler"].keys()


def test_third_party_compose_services_have_a_profile_and_a_pinned_version() -> None:
    profiles = {name: service["profiles"] for name, service in SERVICES.items() if "profiles" in service}
    assert profiles == {
        "postgresql": ["team", "cluster"],
        "prometheus": ["team"],
        "grafana": ["team"],
        "proxy": ["cluster"],
        **{name: ["cluster"] for name in CLUSTER},
    }
    for service in ADDED.values():
        assert re.search(r":v?\d+[\d.]*}$", service["image"])
        assert all(port.startswith("127.0.0.1:") for port in service.get("ports", []))


def test_the_compose_cluster_uses_one_image_and_opens_only_the_proxy_port() -> None:
    assert {SERVICES[name]["image"] for name in CLUSTER} == {"surrogym-cluster"}
    assert {SERVICES[name]["build"]["target"] for name in CLUSTER} == {"cluster"}
    assert [name for name in (*CLUSTER, "proxy") if "ports" in SERVICES[name]] == ["proxy"]
    assert SERVICES["front"]["command"] == ["front.sh"]
    assert "docker/front.sh /usr/local/bin/front.sh" in last("cluster", "COPY")


def test_ray_start_supports_the_options_used_in_the_compose_file() -> None:
    scripts = pytest.importorskip("ray.scripts.scripts")
    known = {option for parameter in scripts.start.params for option in parameter.opts}
    commands = [SERVICES[name]["command"] for name in ("ray-head", "ray-node")]
    script = (COMPOSE.parent / "front.sh").read_text(encoding="utf-8")
    commands.append(["ray", "start", *script.partition("ray start")[2].partition("exec")[0].split()])
    for program, command, *words in commands:
        assert (program, command) == ("ray", "start")
        assert {word for word in words if word.startswith("--")} <= known


def test_compose_session_hosts_run_without_lowered_cpu_priority() -> None:
    assert SERVICES["ray-node"]["environment"]["RAY_worker_niceness"] == "0"


@pytest.mark.skipif(shutil.which("haproxy", path=SEARCHED) is None, reason="HAProxy is not on this machine")
def test_the_load_balancer_configuration_is_valid_for_haproxy() -> None:
    program = shutil.which("haproxy", path=SEARCHED)
    ended = subprocess.run(
        [str(program), "-c", "-f", COMPOSE.parent / "haproxy.cfg"], capture_output=True, text=True, check=False
    )
    assert (ended.returncode, ended.stderr) == (0, "")


def test_the_front_server_script_is_executable_and_joins_ray_without_cpus() -> None:
    script = COMPOSE.parent / "front.sh"
    assert script.stat().st_mode & 0o111
    assert "--num-cpus 0" in script.read_text(encoding="utf-8")


def test_every_path_mounted_by_the_compose_file_exists() -> None:
    mounts = [volume.split(":")[0] for service in ADDED.values() for volume in service["volumes"]]
    files = [mount for mount in mounts if mount.startswith("./")]
    assert len(files) == 4
    assert all((COMPOSE.parent / file).exists() for file in files)
