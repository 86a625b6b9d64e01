"""The page about clusters is true: its programs run, as a reader would start them."""

import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.documentation import blocks, readers_environment
from tests.served import free_port, wait_until
from trompe_client import Client, ServerUnreachable

pytestmark = pytest.mark.cluster

PORTS = ("6379", "10001", "8000")


@contextmanager
def running(script: str, folder: Path, environment: dict[str, str]) -> Iterator[None]:
    """A program in a terminal of its own, for the block."""
    with (folder / "log").open("ab") as log:
        process = subprocess.Popen(["bash", "-c", f"exec {script}"], env=environment, stdout=log, stderr=log)
        try:
            yield
        finally:
            process.terminate()
            process.wait(60)


def answers(server: str) -> bool:
    with Client(server) as client:
        try:
            return bool(client.objects())
        except ServerUnreachable:
            return False


def test_the_page_about_clusters_runs_from_its_beginning_to_its_end(ray_access: None, tmp_path: Path) -> None:
    scripts = "\0".join(code for _, code in blocks("cluster.md", "sh"))
    for port in PORTS:
        scripts = scripts.replace(port, str(free_port()))
    access, cluster, service, jobs = scripts.split("\0")
    server = jobs.partition("--server ")[2].split()[0]
    words = dict(word.split("=") for word in access.split() if "=" in word)
    environment = readers_environment(**words, TROMPE_DATA=str(tmp_path / "data"))
    serve = service.strip() + f" --port {server.rpartition(':')[2]}"
    with running(cluster, tmp_path, environment), running(serve, tmp_path, environment):
        wait_until(lambda: answers(server), story=(tmp_path / "log").read_text)
        done = subprocess.run(["bash", "-ec", jobs], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr + (tmp_path / "log").read_text()
    assert (tmp_path / "out" / "result.json").is_file()
    shutil.rmtree(tmp_path / "data")
