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
    """Folder of everything that is kept."""
    allow_public: bool = False
    """Whether ``serve`` may listen on other addresses than this machine's own."""
    max_upload: int = 512 * 2**20
    """Largest upload, bytes."""
    stall_timeout: float = 1800.0
    """Seconds without progress after which a job's worker is stopped."""
    device: str = "cpu"
    """Where attack workers compute, as torch names it: cpu, cuda, cuda:1."""
    renderers: Annotated[int, Field(ge=1, le=64)] = 1
    """Renderer workers that ``serve`` starts."""
    renderer_patience: float = 10.0
    """Seconds a job waits for a renderer that does not answer."""
    pipeline: str = "trompe_server.attack_job:open_pipeline"
    """``module:function`` that opens the pipeline of a job."""

    @property
    def database(self) -> Path:
        """The SQLite file that holds jobs, events and the engine's own tables."""
        return self.data / "trompe.sqlite"

    @property
    def library(self) -> Path:
        """Folder of uploaded objects, classifiers and backgrounds."""
        return self.data / "library"

    def artifacts(self, job: str) -> Path:
        """Folder of the files of one job."""
        return self.data / "jobs" / job
