"""The stack of docker-compose.yml on a real engine, for tests that see it from outside.

All that they know of the engine is what docker's own client knows: DOCKER_HOST. Where the official images can't be
pulled, ``stand_ins`` takes their place; where PIP_FIND_LINKS names a folder with torch's wheel, the images get it from
there.
"""

import json
import logging
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import pytest

from tests.served import free_port
from trompe_client import Client

ROOT: Final = Path(__file__).parents[2]
STAND_INS: Final = Path(__file__).parent / "stand_ins"
THREADS: Final = Path(__file__).parent / "threads.yml"
OFFICIAL: Final = re.compile(r"image: ((?:postgres|minio/minio):\S+)")
PROFILES: Final = ("--profile", "cluster", "--profile", "s3")
VERSION: Final = "test"
"""Tag of the images under test."""

logger = logging.getLogger(__name__)
logging.getLogger("httpx").setLevel(logging.WARNING)


def docker(*arguments: str, timeout: float = 240, check: bool = True, **options: Any) -> str:
    """What ``docker`` prints. Fails with what it said."""
    command = ["docker", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=timeout, check=False, **options)
    if check and done.returncode:
        raise AssertionError(f"{' '.join(command)} ended with {done.returncode}:\n{done.stdout}{done.stderr}"[-8000:])
    return str(done.stdout).strip()


def answers(*arguments: str) -> bool:
    try:
        docker(*arguments, timeout=600)
    except (AssertionError, OSError, subprocess.TimeoutExpired):
        return False
    return True


@dataclass
class Stack:
    """One compose project: its files, and the variables that are set for it."""

    files: list[Path]
    environment: dict[str, str]
    project: str = field(default_factory=lambda: f"trompe-test-{os.getpid()}")
    _token: str = ""

    def compose(self, *arguments: str, timeout: float = 900) -> str:
        files = [word for file in self.files for word in ("--file", str(file))]
        command = ["compose", "--project-directory", str(ROOT), "--project-name", self.project, *files, *arguments]
        return docker(*command, timeout=timeout, env=os.environ | self.environment)

    def up(self, **scale: int) -> None:
        """Bring everything up, so many containers of each service as ``scale`` says, and wait until it is healthy."""
        scales = [word for name, count in scale.items() for word in ("--scale", f"{name}={count}")]
        self.compose("up", "--detach", "--wait", "--no-build", *scales)

    def containers(self, service: str) -> list[str]:
        """Ids of the running containers of a service."""
        return self.compose("ps", "--quiet", service).split()

    def everything(self) -> list[str]:
        """Ids of all containers, those that ended too."""
        return self.compose("ps", "--all", "--quiet").split()

    def client(self, *, token: str | None = None) -> Client:
        """A client outside, with the token of this stack or another one."""
        return Client(f"http://127.0.0.1:{self.environment['TROMPE_PORT']}", token=token or self.token)

    @property
    def token(self) -> str:
        """The first token, fetched as the manual says."""
        if not self._token:
            self._token = self.compose("run", "--rm", "--no-deps", "token").strip()
        return self._token

    def image(self, name: str) -> str:
        return f"trompe-{name}:{VERSION}"

    def inspect(self, container: str) -> dict[str, Any]:
        found: dict[str, Any] = json.loads(docker("inspect", container))[0]
        return found

    def run_in(self, container: str, *command: str, check: bool = True) -> str:
        return docker("exec", container, *command, check=check)

    def renewed(self, **environment: str) -> "Stack":
        return Stack(self.files, self.environment | environment, self.project, self._token)


def _official_images_missing() -> bool:
    images = OFFICIAL.findall((ROOT / "docker-compose.yml").read_text())
    assert len(images) == 2
    return not all(answers("image", "inspect", image) or answers("pull", "--quiet", image) for image in images)


def _variables_of_the_build() -> dict[str, str]:
    """None, or those that take torch from PIP_FIND_LINKS."""
    folder = Path(os.environ.get("PIP_FIND_LINKS", ""))
    if not (folder.is_absolute() and list(folder.glob("torch-*.whl"))):
        return {}
    logger.info("torch is taken from PIP_FIND_LINKS")
    wheels = "FROM scratch\nCOPY *.whl /\n"
    docker("build", "--quiet", "--tag", "trompe-test-wheels", "--file", "-", str(folder), input=wheels, timeout=300)
    return {"TORCH_INDEX": "", "WHEELS": "trompe-test-wheels"}


@pytest.fixture(scope="session")
def built() -> Stack:
    """The project with its images built, nothing of it running. Skips where no engine answers."""
    if not answers("info"):
        pytest.skip("NO DOCKER ENGINE ANSWERS (DOCKER_HOST): the compose stack is not tested")
    if not answers("compose", "version"):
        pytest.skip("docker has no compose plugin: the compose stack is not tested")
    files = [ROOT / "docker-compose.yml", THREADS]
    if _official_images_missing():
        logger.warning("the official images can't be pulled: Debian's PostgreSQL and moto stand in for them")
        files.append(STAND_INS / "compose.yml")
    fixed = {"TROMPE_VERSION": VERSION, "TROMPE_PORT": str(free_port()), "TROMPE_SILENCE": "15"}
    stack = Stack(files, fixed | _variables_of_the_build())
    stack.compose(*PROFILES, "build", "--quiet", timeout=1800)
    return stack


@pytest.fixture(scope="session")
def stack(built: Stack, request: pytest.FixtureRequest) -> Iterator[Stack]:
    """The stack, up with one container of each service. It is taken down with its volumes at the end."""
    try:
        built.up()
        yield built
    finally:
        if request.session.testsfailed or sys.exc_info()[0]:
            logger.error("%s", built.compose("logs", "--no-color", "--timestamps", "--tail", "200"))
        built.compose(*PROFILES, "down", "--volumes", "--timeout", "5")
