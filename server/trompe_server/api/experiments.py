"""Routes for experiments. An experiment is the jobs with the label ``experiment=<name>``."""

from fastapi import APIRouter

from trompe_server.api import examples
from trompe_server.api.jobs import Cursor, Limit
from trompe_server.api.problems import PROBLEMS
from trompe_server.api.services import ServicesDep
from trompe_server.errors import NotFoundError
from trompe_server.queue.store import EXPERIMENT
from trompe_shared.api import ExperimentInfo, JobList

router = APIRouter(prefix="/v1/experiments", tags=["experiments"], responses=PROBLEMS)


@router.get("", responses=examples.found([examples.EXPERIMENT]))
def list_experiments(services: ServicesDep) -> list[ExperimentInfo]:
    """Experiments with the number of their jobs by state, newest first."""
    return services.store.experiments()


@router.get("/{name:path}", responses=examples.found(examples.JOB_LIST))
def read_experiment(services: ServicesDep, name: str, limit: Limit = 50, cursor: Cursor = None) -> JobList:
    """Jobs of an experiment, newest first."""
    page = services.store.page(labels={EXPERIMENT: name}, limit=limit, cursor=cursor)
    if not page.jobs and cursor is None:
        raise NotFoundError(f"There is no experiment {name!r}. List the experiments to find its name.")
    return page
