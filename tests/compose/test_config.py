"""What docker-compose.yml says, as docker's own client reads it. Needs no engine."""

import json
import os
import re
import subprocess
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).parents[2]
WORKERS = ("worker", "worker-gpu", "dispatcher", "ray-head", "ray-node")
LONG_RUNNING = ("api", *WORKERS, "renderer", "postgres", "objects")
ONE_SHOT = ("secrets", "migrate", "token", "bucket")
PROFILES = ("cluster", "gpu", "s3", "token")


def read(*, profiles: tuple[str, ...] = (), **variables: str) -> dict[str, Any]:
    """The resolved file, with these variables set and no others of its own."""
    chosen = [word for profile in profiles for word in ("--profile", profile)]
    command = ["docker", "compose", *chosen, "config", "--format", "json"]
    plain = {name: os.environ[name] for name in ("PATH", "HOME", "DOCKER_CONFIG") if name in os.environ}
    done = subprocess.run(command, cwd=ROOT, env=plain | variables, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    return found


@pytest.fixture(scope="module")
def config() -> dict[str, Any]:
    try:
        subprocess.run(["docker", "compose", "version"], capture_output=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("DOCKER'S CLIENT WITH ITS COMPOSE PLUGIN IS NOT HERE: docker-compose.yml is not checked")
    return read(profiles=PROFILES)


@pytest.fixture(scope="module")
def services(config: dict[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = config["services"]
    return found


def of(services: dict[str, Any], key: str) -> dict[str, Any]:
    return {name: service.get(key) for name, service in services.items()}


def test_what_comes_up_by_default_needs_neither_a_gpu_nor_an_object_store(services: dict[str, Any]) -> None:
    assert set(services) == {*LONG_RUNNING, *ONE_SHOT}
    assert set(read()["services"]) == {"api", "worker", "renderer", "postgres", "secrets", "migrate"}


@pytest.mark.parametrize("name", [*LONG_RUNNING, *ONE_SHOT])
def test_a_container_is_read_only_without_capabilities_and_bounded(services: dict[str, Any], name: str) -> None:
    service = services[name]
    assert service["read_only"] is True
    assert service["cap_drop"] == ["ALL"]
    assert service["security_opt"] == ["no-new-privileges:true"]
    assert not {"cap_add", "privileged", "devices", "pid", "ipc", "userns_mode"} & set(service)
    assert service["init"] is True
    limits = service["deploy"]["resources"]["limits"]
    assert 2**29 < int(limits["memory"]) <= 2**33
    assert 0 < limits["pids"] <= 512
    assert service["logging"]["options"] == {"max-size": "10m", "max-file": "3"}
    assert all("size=" in mount for mount in service.get("tmpfs", []))


def test_what_runs_for_long_is_started_again_and_may_end_in_order(services: dict[str, Any]) -> None:
    for name in LONG_RUNNING:
        assert services[name]["restart"] == "unless-stopped", name
        assert services[name]["stop_grace_period"], name
    assert {services[name]["restart"] for name in ONE_SHOT} == {"no"}


def test_the_api_alone_is_published_and_on_this_machine_alone(services: dict[str, Any]) -> None:
    published = {name: ports for name, ports in of(services, "ports").items() if ports}
    assert list(published) == ["api"]
    (port,) = published["api"]
    assert (port["host_ip"], port["published"], port["target"]) == ("127.0.0.1", "8000", 8000)


def test_networks_are_internal_but_the_one_that_the_api_is_published_from(config: dict[str, Any]) -> None:
    internal = {name: bool(network.get("internal")) for name, network in config["networks"].items()}
    assert internal == {"outside": False, "state": True, "render": True}
    networks = of(config["services"], "networks")
    assert [name for name, of_it in networks.items() if "outside" in (of_it or {})] == ["api"]


def test_renderers_share_no_network_with_the_database_and_the_object_store(services: dict[str, Any]) -> None:
    networks = {name: set(of_it or {}) for name, of_it in of(services, "networks").items()}
    assert networks["renderer"] == {"render"}
    assert networks["postgres"] == networks["objects"] == {"state"}
    assert services["secrets"]["network_mode"] == services["token"]["network_mode"] == "none"


def test_nothing_of_the_host_is_mounted(services: dict[str, Any]) -> None:
    mounts = [mount for service in services.values() for mount in service.get("volumes", [])]
    assert {mount["type"] for mount in mounts} == {"volume"}


MAKERS = {("migrate", "token-secret")} | {("secrets", f"{name}-secret") for name in ("database", "objects", "cluster")}


def test_secrets_are_in_volumes_of_those_alone_who_need_them_and_in_no_variable(services: dict[str, Any]) -> None:
    readers: dict[str, set[str]] = {}
    for name, service in services.items():
        for mount in service.get("volumes", []):
            if mount["source"].endswith("-secret"):
                readers.setdefault(mount["source"], set()).add(name)
                assert mount.get("read_only") or (name, mount["source"]) in MAKERS, (name, mount)
    workers = {"api", *WORKERS}
    assert readers == {
        "token-secret": {"migrate", "token"},
        "database-secret": {"secrets", "migrate", "postgres", *workers},
        "objects-secret": {"secrets", "bucket", "objects", *workers},
        "cluster-secret": {"secrets", "dispatcher", "ray-head", "ray-node"},
    }
    variables = [pair for service in services.values() for pair in (service.get("environment") or {}).items()]
    for variable, value in variables:
        assert not re.search("PASSWORD|SECRET|TOKEN|KEY", variable) or variable.endswith(("_FILE", "_PATH")), variable
        assert not (value and "@" in value and ":" in value.partition("//")[2].partition("@")[0]), variable


def test_images_are_pinned_and_those_of_others_are_told_a_user(services: dict[str, Any]) -> None:
    for name, service in services.items():
        assert re.search(r"\d", service["image"].rpartition(":")[2]), (name, service["image"])
        assert service["image"].startswith("trompe-") or service["user"].split(":")[0] not in {"root", "0"}, name


def test_each_image_of_ours_is_built_by_one_service_and_pulled_by_none(services: dict[str, Any]) -> None:
    ours = {name: service for name, service in services.items() if service["image"].startswith("trompe-")}
    built = [service["image"] for service in ours.values() if "build" in service]
    assert sorted(built) == sorted({service["image"] for service in ours.values()})
    assert {service["pull_policy"] for service in ours.values()} == {"never"}


def test_nobody_starts_before_the_tables_and_the_database_are_there(services: dict[str, Any]) -> None:
    for name in ("api", "worker", "worker-gpu", "dispatcher", "ray-head"):
        conditions = {other: each["condition"] for other, each in services[name]["depends_on"].items()}
        assert conditions["migrate"] == "service_completed_successfully"
        assert conditions["postgres"] == "service_healthy"
    assert services["migrate"]["depends_on"]["postgres"]["condition"] == "service_healthy"
    assert services["postgres"]["depends_on"]["secrets"]["condition"] == "service_completed_successfully"


def test_a_gpu_is_asked_for_by_its_profile_alone(services: dict[str, Any]) -> None:
    reserved = {name: each["deploy"]["resources"].get("reservations", {}) for name, each in services.items()}
    assert {name for name, found in reserved.items() if found.get("devices")} == {"worker-gpu"}
    assert services["worker-gpu"]["environment"]["TROMPE_DEVICE"] == "cuda"
    assert services["worker-gpu"]["build"]["args"]["TORCH_INDEX"] == ""
    assert services["worker"]["build"]["args"]["TORCH_INDEX"].endswith("/cpu")


def test_the_cluster_is_reached_by_its_dispatcher_with_a_token_and_publishes_nothing(services: dict[str, Any]) -> None:
    for name in ("dispatcher", "ray-head", "ray-node"):
        environment = services[name]["environment"]
        assert (environment["RAY_AUTH_MODE"], environment["RAY_AUTH_TOKEN_PATH"]) == ("token", "/secrets/cluster/token")
        assert environment["RAY_USAGE_STATS_ENABLED"] == "0"
    assert services["dispatcher"]["environment"]["TROMPE_EXECUTOR"] == "ray://ray-head:10001"
    assert services["ray-node"]["deploy"]["replicas"] == 2
    assert {services[name]["image"] for name in ("dispatcher", "ray-head", "ray-node")} == {"trompe-cluster:0.2.0"}


def test_numbers_address_and_store_are_chosen_by_variables(services: dict[str, Any]) -> None:
    chosen = read(TROMPE_WORKERS="3", TROMPE_RENDERERS="5", TROMPE_PORT="9000", TROMPE_STORE="s3://mine")["services"]
    assert chosen["worker"]["environment"]["TROMPE_WORKERS"] == "3"
    assert chosen["renderer"]["deploy"]["replicas"] == 5
    assert chosen["api"]["ports"][0]["published"] == "9000"
    assert {chosen[name]["environment"]["TROMPE_STORE"] for name in ("api", "worker", "migrate")} == {"s3://mine"}


def test_kubernetes_runs_the_same_image_and_ray_as_compose(services: dict[str, Any]) -> None:
    manifest = (ROOT / "deploy" / "kuberay" / "trompe.yaml").read_text()
    ray, *dispatcher = yaml.safe_load_all(manifest)
    constraints = (ROOT / "deploy" / "image" / "constraints.txt").read_text().splitlines()
    assert f"ray=={ray['spec']['rayVersion']}" in constraints
    assert set(re.findall(r"image: (?:&image )?([\w:.-]+)", manifest)) == {services["ray-node"]["image"]}
    assert [each["kind"] for each in dispatcher] == ["Deployment"]
    assert ray["spec"]["authOptions"] == {"mode": "token"}


def test_the_images_end_as_an_unprivileged_user_and_tell_their_health() -> None:
    found = re.findall(r"^FROM (\S+) AS (\w+)\n(.*?)(?=^FROM|\Z)", (ROOT / "Dockerfile").read_text(), re.DOTALL | re.M)
    assert {base for base, *_ in found} == {"${WHEELS}", "python:3.11-slim", "python", "server", "worker"}
    stages = {name: stage for _, name, stage in found}
    for name in ("renderer", "server"):
        assert [line for line in stages[name].splitlines() if line.startswith("USER")] == ["USER trompe"]
        assert "\nHEALTHCHECK " in stages[name]
    assert "torch" not in stages["renderer"]
