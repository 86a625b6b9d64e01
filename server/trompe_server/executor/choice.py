"""The executor that the settings name."""

from trompe_server.executor.local import LocalExecutor
from trompe_server.executor.port import Executor
from trompe_server.executor.process import Setup
from trompe_server.renderers.discovery import RendererAddresses
from trompe_server.settings import Settings


def open_executor(settings: Settings, renderers: RendererAddresses, *, mark: str) -> Executor:
    """Start the processes of this machine, or connect to the cluster. ``mark``: name of the dispatcher with the lease.

    Raises ``ServiceError`` if the cluster cannot be used.
    """
    setup = Setup(settings, renderers)
    if settings.executor == "local":
        return LocalExecutor(setup)
    from trompe_server.executor.ray_cluster import RayExecutor

    return RayExecutor(setup, mark=mark)
