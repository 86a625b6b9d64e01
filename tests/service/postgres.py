"""A private PostgreSQL cluster on a free port, which tests can stop and restart."""

import os
import pwd
import secrets
import shutil
import subprocess
import tempfile
from contextlib import ExitStack, suppress
from pathlib import Path

import psycopg

from tests.served import reserved_port

OPTIONS = "-c fsync=off -c full_page_writes=off -c max_connections=200"


def find_programs() -> Path | None:
    """The newest folder with initdb."""
    found = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"), key=lambda each: int(each.parts[-3]))
    if found:
        return found[-1].parent
    here = shutil.which("initdb")
    return Path(here).resolve().parent if here else None


class Postgres:
    """A cluster in a temporary folder. PostgreSQL refuses to run as root, so root runs it as nobody."""

    def __init__(self, programs: Path) -> None:
        self._programs = programs
        self._user = "nobody" if os.geteuid() == 0 else None
        self.folder = Path(tempfile.mkdtemp(prefix="trompe-pg-"))
        if self._user is not None:
            os.chown(self.folder, pwd.getpwnam(self._user).pw_uid, -1)
        self._open = ExitStack()
        self.port = self._open.enter_context(reserved_port())
        self._do("initdb", "--username=trompe", "--auth=trust", "--encoding=UTF8", "--no-sync", "-D", self._data)

    @property
    def _data(self) -> str:
        return str(self.folder / "data")

    def start(self) -> None:
        options = f"-p {self.port} -k {self.folder} -c listen_addresses=127.0.0.1 {OPTIONS}"
        log = str(self.folder / "log")
        self._do("pg_ctl", "start", "--wait", "--timeout=180", "-D", self._data, "-l", log, "-o", options)

    def stop(self) -> None:
        """Stop at once and cut connections, like a crash."""
        self._do("pg_ctl", "stop", "--wait", "--mode=immediate", "-D", self._data)

    def database(self) -> str:
        """The URL of a new, empty database."""
        name = f"t{secrets.token_hex(6)}"
        with psycopg.connect(f"postgresql://trompe@127.0.0.1:{self.port}/postgres", autocommit=True) as connection:
            connection.execute(f"CREATE DATABASE {name}")
        return f"postgresql://trompe@127.0.0.1:{self.port}/{name}"

    def close(self) -> None:
        with suppress(subprocess.CalledProcessError):  # it is stopped already
            self.stop()
        shutil.rmtree(self.folder, ignore_errors=True)
        self._open.close()

    def _do(self, program: str, *arguments: str) -> None:
        command = [str(self._programs / program), *arguments]
        quiet = subprocess.DEVNULL
        subprocess.run(command, user=self._user, cwd="/", stdin=quiet, stdout=quiet, stderr=quiet, check=True)
