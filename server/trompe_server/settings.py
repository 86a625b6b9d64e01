"""What can be set from outside: environment variables that begin with TROMPE_, and the options of the commands."""

from pathlib import Path
from typing import Annotated

from pydantic import Field
from pydantic_settings import BaseSettings, SettingsConfigDict

__all__ = ["Settings"]


class Settings(BaseSettings):
    """Settings of the service. ``TROMPE_DATA`` sets ``data``, and so on."""

    model_config = SettingsConfigDict(env_prefix="TROMPE_", frozen=True)

    data: Path = Path.home() / ".local" / "share" / "trompe"
    """Folder of everything that is kept, as far as ``database`` and ``store`` name no other place."""
    database: str = ""
    """URL of the database, SQLite or PostgreSQL; empty is a file in the data folder."""
    store: str = ""
    """URL of the store of artifacts and uploads: a local folder, or any that fsspec knows; empty is the data folder."""
    max_upload: int = 512 * 2**20
    """Largest upload, bytes."""
    rate_limit: Annotated[float, Field(ge=0)] = 100.0
    """Requests per second that the API serves each token, or each address without one; 0 sets no limit."""
    stall_timeout: float = 1800.0
    """Seconds without progress after which a job's worker is stopped."""
    silence: Annotated[float, Field(ge=1.0)] = 30.0
    """Seconds without a heartbeat after which a worker counts as dead, and its job goes to another."""
    retention_days: Annotated[float, Field(ge=0)] = 0.0
    """Days after which jobs that have ended, their artifacts and unused calibrations are deleted; 0 keeps them."""
    device: str = "cpu"
    """Where attack workers compute, as torch names it: cpu, cuda, cuda:1."""
    workers: Annotated[int, Field(ge=0, le=64)] = 1
    """Attack workers that ``serve`` starts; they share the cores. With 0 others must come from elsewhere."""
    renderers: Annotated[int, Field(ge=0, le=64)] = 1
    """Renderer workers that ``serve`` starts."""
    renderer_patience: float = 10.0
    """Seconds a job waits for a renderer that does not answer."""
    pipeline: str = "trompe_server.attack_job:open_pipeline"
    """``module:function`` that opens the pipeline of a job."""

    @property
    def database_url(self) -> str:
        """The database that holds jobs, events, workers and tokens."""
        return self.database or f"sqlite:///{self.data.absolute() / 'trompe.sqlite'}"

    @property
    def store_url(self) -> str:
        """Where the files of jobs and the library are."""
        return self.store or str(self.data.absolute())
