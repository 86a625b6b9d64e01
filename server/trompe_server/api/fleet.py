"""Routes for attack workers and renderer workers."""

from fastapi import APIRouter

from trompe_server.api import examples
from trompe_server.api.problems import PROBLEMS
from trompe_server.api.services import ServicesDep, StoreDep
from trompe_shared.api import RendererInfo, WorkerInfo

router = APIRouter(prefix="/v1", tags=["workers"], responses=PROBLEMS)


@router.get("/workers", responses=examples.found([examples.WORKER]))
def list_workers(store: StoreDep) -> list[WorkerInfo]:
    """Attack workers, by their latest heartbeats."""
    return store.workers()


@router.get("/renderers", responses=examples.found([examples.RENDERER]))
def list_renderers(services: ServicesDep) -> list[RendererInfo]:
    """Renderer workers of this server: whether they accept connections, and their engines."""
    return services.renderers()
