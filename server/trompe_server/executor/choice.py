"""The executor that the settings name."""

import os
import shutil

from trompe_server.executor.local import LocalExecutor
from trompe_server.executor.port import Executor
from trompe_server.executor.process import Setup
from trompe_server.renderers.discovery import RendererAddresses
from trompe_server.settings import Settings

__all__ = ["open_executor"]


def open_executor(settings: Settings, renderers: RendererAddresses, *, mark: str) -> Executor:
    """Start the processes of this machine, or connect to the cluster. ``mark``: name of the dispatcher with the lease.

    Raises ``ServiceError`` if the cluster cannot be used.
    """
    shutil.rmtree(settings.metrics_folder, ignore_errors=True)
    settings.metrics_folder.mkdir(parents=True)
    environment = {"PROMETHEUS_MULTIPROC_DIR": str(settings.metrics_folder)}
    if settings.executor == "local":
        environment["OMP_NUM_THREADS"] = os.environ.get("OMP_NUM_THREADS", _threads(settings.workers))
        return LocalExecutor(Setup(settings, renderers, tuple(environment.items())))
    from trompe_server.executor.ray_cluster import RayExecutor

    return RayExecutor(Setup(settings, renderers, tuple(environment.items())), mark=mark)


def _threads(workers: int) -> str:
    return str(max(1, len(os.sched_getaffinity(0)) // workers))
