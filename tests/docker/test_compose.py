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
def test_no_program_runs_as_root(target: str) -> None:
    user = last(target, "USER")
    assert any(f"useradd --uid 1000 --create-home {user}" in line for line in whole(target))
    assert not [line for line in whole(target)[whole(target).index(f"USER {user}") :] if line.startswith("RUN ")]


def test_the_server_says_whether_it_is_well() -> None:
    assert "/healthz" in last("server", "HEALTHCHECK")


def test_the_sampler_carries_no_torch() -> None:
    assert not [line for line in whole("sampler") if "torch" in line]


def test_torch_is_its_cpu_build_unless_a_build_argument_says_cuda() -> None:
    assert "ARG TORCH=cpu" in whole("torch")
    assert all(service["build"]["args"]["TORCH"] == "${TORCH:-cpu}" for service in BUILT.values())
    (choice,) = [line for line in whole("torch") if "torch.version.cuda" in line]
    assert "exit 1" in choice
    assert "set PIP_EXTRA_INDEX_URL" in choice
    assert "ARG PIP_EXTRA_INDEX_URL" in whole("torch")


def test_no_host_of_packages_is_named() -> None:
    """Where packages come from is the reader's choice: pip's settings, or a build argument without a default."""
    assert re.findall(r"\w+://([\w.]+)", DOCKERFILE) == ["127.0.0.1"]
    assert all(
        service["build"]["args"]["PIP_EXTRA_INDEX_URL"] == "${PIP_EXTRA_INDEX_URL:-}" for service in BUILT.values()
    )


def test_every_install_is_pinned_and_no_image_keeps_a_cache() -> None:
    installs = [line for line in DOCKERFILE.splitlines() if "pip install" in line]
    assert installs
    assert all("-c constraints.txt" in line or "--no-deps" in line for line in installs)
    assert DOCKERFILE.count("PIP_NO_CACHE_DIR=1") == DOCKERFILE.count("FROM ${BASE_IMAGE}")


def test_whatever_is_copied_is_there_and_not_ignored() -> None:
    ignored = (ROOT / ".dockerignore").read_text(encoding="utf-8").splitlines()
    copied = [line.split()[1:-1] for line in DOCKERFILE.splitlines() if line.startswith("COPY ")]
    for source in (source for sources in copied for source in sources):
        assert (ROOT / source).exists()
        assert f"!{source}" in ignored


@pytest.mark.parametrize("name", BUILT)
def test_a_service_is_built_from_a_target_of_the_dockerfile(name: str) -> None:
    build = SERVICES[name]["build"]
    assert (COMPOSE.parent / build["context"] / build["dockerfile"]).samefile(ROOT / "docker" / "Dockerfile")
    assert build["target"] in stages()


@pytest.mark.parametrize("name", BUILT)
def test_no_service_starts_without_a_token_of_ones_own(name: str) -> None:
    tokens = {key: value for key, value in SERVICES[name]["environment"].items() if key.endswith("_TOKEN")}
    assert tokens
    assert all(value.startswith("${SURROGYM_TOKEN:?expected ") for value in tokens.values())


@pytest.mark.parametrize("name", CLIENTS)
def test_a_client_gives_a_known_command_and_waits_by_itself(name: str) -> None:
    values = parse([DEFAULT.sub(r"\1", word) for word in SERVICES[name]["command"]])
    assert values["wait"] >= 60
    assert SERVICES[name]["environment"]["SURROGYM_URL"] == "${SURROGYM_URL:-http://server:8000}"


def test_the_server_is_reachable_from_this_machine_alone() -> None:
    assert [port.startswith("127.0.0.1:") for port in SERVICES["server"]["ports"]] == [True]


def test_database_and_policy_lie_in_the_volume() -> None:
    assert "SURROGYM_DATABASE=/data/" in last("server", "ENV")
    trainer = SERVICES["trainer"]
    policy = parse([DEFAULT.sub(r"\1", word) for word in trainer["command"]])["out"]
    assert Path(policy).parent == Path("/data")
    assert SERVICES["server"]["volumes"] == trainer["volumes"] == ["data:/data"]


def test_samplers_can_be_scaled() -> None:
    assert not {"container_name", "ports"} & SERVICES["sampler"].keys()


def test_what_is_not_built_here_waits_for_its_profile_and_has_a_version() -> None:
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


def test_the_cluster_has_one_image_and_opens_no_port_but_the_proxys() -> None:
    assert {SERVICES[name]["image"] for name in CLUSTER} == {"surrogym-cluster"}
    assert {SERVICES[name]["build"]["target"] for name in CLUSTER} == {"cluster"}
    assert [name for name in (*CLUSTER, "proxy") if "ports" in SERVICES[name]] == ["proxy"]
    assert SERVICES["front"]["command"] == ["front.sh"]
    assert "docker/front.sh /usr/local/bin/front.sh" in last("cluster", "COPY")


def test_ray_has_the_options_that_it_is_started_with() -> None:
    scripts = pytest.importorskip("ray.scripts.scripts")
    known = {option for parameter in scripts.start.params for option in parameter.opts}
    commands = [SERVICES[name]["command"] for name in ("ray-head", "ray-node")]
    script = (COMPOSE.parent / "front.sh").read_text(encoding="utf-8")
    commands.append(["ray", "start", *script.partition("ray start")[2].partition("exec")[0].split()])
    for program, command, *words in commands:
        assert (program, command) == ("ray", "start")
        assert {word for word in words if word.startswith("--")} <= known


def test_no_other_program_goes_before_a_step_of_a_session_host() -> None:
    assert SERVICES["ray-node"]["environment"]["RAY_worker_niceness"] == "0"


@pytest.mark.skipif(shutil.which("haproxy", path=SEARCHED) is None, reason="HAProxy is not on this machine")
def test_haproxy_understands_the_configuration_of_the_load_balancer() -> None:
    program = shutil.which("haproxy", path=SEARCHED)
    ended = subprocess.run(
        [str(program), "-c", "-f", COMPOSE.parent / "haproxy.cfg"], capture_output=True, text=True, check=False
    )
    assert (ended.returncode, ended.stderr) == (0, "")


def test_the_script_of_a_front_server_can_run_and_joins_without_cpus() -> None:
    script = COMPOSE.parent / "front.sh"
    assert script.stat().st_mode & 0o111
    assert "--num-cpus 0" in script.read_text(encoding="utf-8")


def test_what_is_mounted_is_there() -> None:
    mounts = [volume.split(":")[0] for service in ADDED.values() for volume in service["volumes"]]
    files = [mount for mount in mounts if mount.startswith("./")]
    assert len(files) == 4
    assert all((COMPOSE.parent / file).exists() for file in files)
