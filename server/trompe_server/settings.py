"""Settings of the service: environment variables that begin with TROMPE_, and options of the commands."""

from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, BeforeValidator, Field
from pydantic_core import from_json
from pydantic_settings import BaseSettings, SettingsConfigDict

from trompe_shared.engine import DEFAULT_ENGINE


def _decoded(value: Any) -> Any:
    """JSON of the environment as what it says, other values as they are. Raises ``ValueError``."""
    try:
        return from_json(value) if isinstance(value, str) else value
    except ValueError as error:
        raise ValueError(f'{value!r} is not a JSON list, such as ["a", "b"]') from error


Texts = Annotated[tuple[str, ...], BeforeValidator(_decoded)]


class Settings(BaseSettings):
    """Settings of the service. ``TROMPE_DATA`` sets ``data``, and so on; an empty variable sets nothing."""

    model_config = SettingsConfigDict(env_prefix="TROMPE_", frozen=True, enable_decoding=False, env_ignore_empty=True)

    data: Annotated[Path, AfterValidator(Path.expanduser)] = Path.home() / ".local" / "share" / "trompe"
    """Folder of all data, except what ``database`` and ``store`` place elsewhere."""
    database: str = ""
    """URL of the database, SQLite or PostgreSQL; empty: a file in the data folder."""
    store: str = ""
    """Store of artifacts and uploads: a local folder, or any URL fsspec supports; empty: the data folder."""
    max_upload: Annotated[int, Field(gt=0)] = 512 * 2**20
    """Largest upload, bytes."""
    rate_limit: Annotated[float, Field(ge=0)] = 100.0
    """Requests per second allowed to each token, or to each address without a token; 0: no limit."""
    executor: Annotated[str, Field(pattern=r"^(local|ray-local|ray://[^:/]+:\d+)$")] = "local"
    """What runs the jobs: ``local``, processes of this machine; ``ray://HOST:PORT``, a Ray cluster; ``ray-local``, Ray
    on this machine alone."""
    stall_timeout: Annotated[float, Field(gt=0)] = 1800.0
    """Seconds without progress after which an attempt counts as lost."""
    silence: Annotated[float, Field(ge=1.0, le=86_400.0)] = 30.0
    """Seconds without a heartbeat or answer after which an attempt, the dispatcher or a renderer of ``trompe serve``
    counts as dead and is replaced."""
    retention_days: Annotated[float, Field(ge=0)] = 0.0
    """Days after which ended jobs, their artifacts and unused calibrations are deleted; 0 keeps them."""
    device: Annotated[str, Field(pattern=r"^(cpu|cuda(:\d+)?)$")] = "cpu"
    """Device of the attack workers, by torch's name: cpu, cuda, cuda:1."""
    workers: Annotated[int, Field(ge=0, le=64)] = 1
    """Attack workers of this machine; they share the cores. 0: ``serve`` leaves the jobs to a ``trompe worker``."""
    renderers: Annotated[int, Field(ge=0, le=64)] = 1
    """Renderer workers started by ``serve``."""
    engine: str = DEFAULT_ENGINE
    """Engine of these renderer workers, as in ``trompe render --engine``: a name or ``module:Class``."""
    engine_options: Texts = ()
    """Options of that engine, each ``NAME=VALUE``; in the environment a JSON list."""
    networks: Texts = ()
    """Networks by name that jobs may use, as patterns (``timm:*``, ``hf:google/vit-base-patch16-224``); in the
    environment a JSON list."""
    renderer_patience: Annotated[float, Field(ge=0)] = 60.0
    """Seconds a job waits for a renderer."""
    pipeline: str = "trompe_server.job.texture_attack:open_job"
    """``module:function`` that opens a job, with the signature of the default; replaced by tests."""
    metrics_port: Annotated[int, Field(ge=0, le=65535)] = 0
    """Port at which ``trompe worker`` serves the Prometheus metrics of its processes; 0: none."""

    @property
    def engine_flags(self) -> list[str]:
        """The engine as words of ``trompe render``; none for its default."""
        engine = [] if self.engine == DEFAULT_ENGINE else ["--engine", self.engine]
        return [*engine, *(word for option in self.engine_options for word in ("--set", option))]

    @property
    def database_url(self) -> str:
        """URL of the database of jobs, events, workers and tokens."""
        from sqlalchemy import URL  # late: commands read settings at their start

        file = str(self.data.absolute() / "trompe.sqlite")
        return self.database or URL.create("sqlite", database=file).render_as_string()

    @property
    def store_url(self) -> str:
        """URL of the files of jobs and of the library."""
        return self.store or str(self.data.absolute())
