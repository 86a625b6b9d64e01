"""Addresses of the pages."""

import asyncio
import json
import logging
import re
from collections import Counter
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Final, Literal
from urllib.parse import urlencode

from fastapi import APIRouter, Form, Query, Request
from fastapi import Path as PathParam
from fastapi.responses import HTMLResponse, RedirectResponse, Response
from pydantic import ValidationError
from sse_starlette import EventSourceResponse, ServerSentEvent

from trompe_server.api.guard import COOKIE
from trompe_server.api.jobs import RESULT, Cursor, labels_of
from trompe_server.api.services import Services, ServicesDep
from trompe_server.errors import NotFoundError
from trompe_server.formats import write_glb
from trompe_server.judgement.suites import SUITES
from trompe_server.pages.chart import chart
from trompe_server.pages.estimate import estimate
from trompe_server.pages.experiment import OUTCOME, cells_of, differing_options, points_of
from trompe_server.pages.form import form_fields
from trompe_server.pages.naming import Names
from trompe_server.pages.offline import offline_page
from trompe_server.pages.orbit import orbit, painted
from trompe_server.pages.present import PHASES, TERMS, JobRow, Shown, differences, present
from trompe_server.pages.results import Kind, ViewSet, outcome_of, picture_png
from trompe_server.pages.serving import page, render
from trompe_server.pages.turntable import TURNS, turntable
from trompe_server.queue.store import EXPERIMENT
from trompe_server.storage.database import DatabaseDownError
from trompe_server.storage.tokens import hash_secret
from trompe_shared.api import JOB_RESULT, MANIFEST_PAGE, Job, JobSpec, JobState, Result, in_parts
from trompe_shared.presets import PRESETS
from trompe_shared.shipped import shipped_objects

logger = logging.getLogger(__name__)

router = APIRouter(include_in_schema=False)

GALLERY: Final[Mapping[str, Any]] = json.loads((Path(__file__).parent / "gallery.json").read_bytes())
"""The start page's example; ``scripts/make_gallery.py`` writes it."""

LATEST: Final = 8
PAGE: Final = 50
MOST_COMPARED: Final = 6
EXPERIMENT_PAGE: Final = 500
RECENT: Final = 200
"""Jobs from which an estimate is made."""
STREAM_INTERVAL: Final = 1.0
LASTING: Final = {"Cache-Control": "private, max-age=31536000, immutable"}

State = Annotated[str, Query(pattern=f"^({'|'.join(map(re.escape, JobState))})?$")]
Label = Annotated[str, Query(max_length=264)]


@router.get("/")
def home(request: Request, services: ServicesDep) -> HTMLResponse:
    return page(request, "home.html", gallery=GALLERY, rows=_rows(services, limit=LATEST)[0])


@router.get("/jobs")
def jobs(
    request: Request, services: ServicesDep, state: State = "", label: Label = "", cursor: Cursor = None
) -> HTMLResponse:
    rows, older = _rows(services, state=state, label=label, cursor=cursor)
    filters = {"state": state, "label": label}
    # Older pages show the same jobs, updated.
    stream = "/jobs/stream?" + urlencode(filters if cursor is None else {"ids": ",".join(row.id for row in rows)})
    return page(
        request,
        "jobs.html",
        rows=rows,
        filters=filters,
        counts=services.store.counts(),
        stream=stream,
        first=cursor is None,
        newest=_list_url(filters),
        older=older and _list_url(filters, cursor=older),
    )


@router.get("/jobs/stream")
def follow_list(
    services: ServicesDep, state: State = "", label: Label = "", ids: str = "", limit: int = PAGE
) -> EventSourceResponse:
    """Stream of the list, newest first: see ``_changes``."""

    def look() -> tuple[list[JobRow], str | None]:
        if ids:
            rows = [_row(services, job) for each in ids.split(",")[:PAGE] if (job := _found(services, each))]
            return rows, None
        rows, older = _rows(services, state=state, label=label, limit=min(max(limit, 1), PAGE))
        return rows, older and _list_url({"state": state, "label": label}, cursor=older)

    return EventSourceResponse(_changes(look), ping=15)


@router.get("/jobs/new")
def new_job(request: Request, services: ServicesDep) -> HTMLResponse:
    return page(
        request,
        "new.html",
        **_choices(services),
        fields=form_fields(),
        renderers=list(dict.fromkeys(each.identity for each in services.renderers() if each.identity)),
        presets={name: {"help": one.help, "options": in_parts(one.options)} for name, one in PRESETS.items()},
    )


@router.get("/jobs/estimate")
def show_estimate(
    services: ServicesDep,
    classifier: str,
    pool: int,
    steps: int,
    epsilon: Annotated[float, Query(gt=0)],
) -> Mapping[str, str | None]:
    """Seconds and drop of stored jobs of this effort against this classifier, in words."""
    reference = services.library.classifier(classifier).reference
    found = services.store.page(state=JobState.succeeded, classifier=reference, limit=RECENT).jobs
    ended = [(job, outcome) for job in found if (outcome := outcome_of(services.artifacts(job.id)))]
    return {"text": estimate(ended, pool=pool, steps=steps, epsilon=epsilon)}


@router.get("/judgements/new")
def new_judgement(request: Request, services: ServicesDep, job: str | None = None) -> HTMLResponse:
    """The form of a new judgement; of the result of ``job``, if it is given."""
    given = None if job is None else _painted(services.store.get(job))
    return page(request, "new_judgement.html", **_choices(services), given=given, suites=list(SUITES))


router.get("/jobs/turntable/{reference}.png")(turntable)


@router.get("/jobs/compare")
def compare(
    request: Request, services: ServicesDep, job: Annotated[list[str], Query(min_length=2, max_length=MOST_COMPARED)]
) -> HTMLResponse:
    names, sides, asked, results = Names(services.library), [], [], []
    for each in job:
        found = services.store.get(each)
        result = _result(services, found)
        if result is None:
            raise NotFoundError(f"Job {each} is {found.state} and has no result to compare.")
        row = names.row(found)
        asked.append(names.options(found))
        results.append(result)
        sides.append({"job": row, "shown": _shown(services, row, result)})
    return page(request, "compare.html", sides=sides, lines=differences(asked, results))


@router.get("/jobs/{job}")
def show_job(request: Request, services: ServicesDep, job: str) -> HTMLResponse:
    found = services.store.get(job)
    row, result = _row(services, found), _result(services, found)
    if result is None:
        return page(request, "job.html", job=row, shown=None, phases=PHASES)
    turned = orbit(result, job, services.library.classifiers.all())
    return page(request, "job.html", job=row, shown=_shown(services, row, result), orbit=turned, terms=TERMS)


@router.get("/jobs/{job}/result.html")
def result_file(services: ServicesDep, job: str) -> Response:
    """The result as one HTML file to keep. It has scripts of its own, so it is not to be opened on this server."""
    found = services.store.get(job)
    if (result := _result(services, found)) is not None:
        row = Names(services.library).row(found)
        text = offline_page(services, found, row, _shown(services, row, result))
    elif MANIFEST_PAGE in found.artifacts:
        text = services.artifacts(job).read(MANIFEST_PAGE).decode()
    else:
        raise NotFoundError(f"Job {job} is {found.state} and has no result.")
    disposition = {"Content-Disposition": f'attachment; filename="{found.id}.html"'}
    return Response(text, media_type="text/html", headers=disposition)


@router.get("/jobs/{job}/models/{side}.glb")
def show_model(services: ServicesDep, job: str, side: Literal["before", "after"]) -> Response:
    """The object before or after the attack, for the orbit."""
    model = write_glb(painted(services, services.store.get(job), side))
    return Response(model, media_type="model/gltf-binary", headers=LASTING)


@router.get("/jobs/{job}/preview.png")
def preview(services: ServicesDep, job: str) -> Response:
    """The object at present, in surrogate and target; 204 before the first one."""
    services.store.get(job)
    try:
        return Response(services.artifacts(job).read("preview.png"), media_type="image/png")
    except FileNotFoundError:
        return Response(status_code=204)


@router.get("/jobs/{job}/pictures/{view_set}/{index}/{kind}.png")
def picture(
    services: ServicesDep,
    job: str,
    view_set: ViewSet,
    index: Annotated[int, PathParam(ge=0)],
    kind: Kind,
) -> Response:
    services.store.get(job)
    try:
        data = picture_png(services.artifacts(job), view_set, index, kind)
    except (FileNotFoundError, IndexError, KeyError) as error:
        raise NotFoundError(f"Job {job} has no picture {view_set} {index} {kind}.") from error
    return Response(data, media_type="image/png", headers=LASTING)


@router.get("/experiments")
def experiments(request: Request, services: ServicesDep) -> HTMLResponse:
    return page(request, "experiments.html", experiments=services.store.experiments())


@router.get("/experiments/{name:path}")
def show_experiment(request: Request, services: ServicesDep, name: str, cursor: Cursor = None) -> HTMLResponse:
    found = services.store.page(labels={EXPERIMENT: name}, limit=EXPERIMENT_PAGE, cursor=cursor)
    if not found.jobs:
        raise NotFoundError(f"There is no experiment {name!r}.")
    names = Names(services.library)
    attacks = [job for job in found.jobs if isinstance(job.spec, JobSpec)]
    entries = [(names.row(job), names.options(job), _result(services, job)) for job in attacks]
    options = differing_options(entries)
    return page(
        request,
        "experiment.html",
        name=name,
        counts=Counter(row.state for row, _, _ in entries),
        chart=chart(points_of(entries, options)),
        columns=[*options, *OUTCOME],
        lines=[(entry[0], cells_of(entry, options)) for entry in entries],
        whole=cursor is None and found.next_cursor is None,
        older=found.next_cursor and f"?{urlencode({'cursor': found.next_cursor})}",
    )


@router.get("/docs")
def docs(request: Request) -> HTMLResponse:
    return page(request, "docs.html", api=request.app.openapi())


@router.get("/login")
def login(request: Request, next: str = "/") -> HTMLResponse:
    return page(request, "login.html", next=next, wrong=None)


@router.post("/login")
def sign_in(
    request: Request,
    services: ServicesDep,
    token: Annotated[str, Form(max_length=200)],
    next: Annotated[str, Form(max_length=2000)] = "/",
) -> Response:
    """Keep the token in a cookie, unreadable by scripts and unused by other sites."""
    known = services.tokens.by_hash().get(hash_secret(token.strip()))
    if known is None or known.revoked is not None:
        wrong = "This is not a valid token. Tokens begin with trompe_ and are printed once, by trompe token create."
        return page(request, "login.html", status=401, next=next, wrong=wrong)
    own = next.startswith("/") and not next.startswith(("//", "/\\"))
    answer = RedirectResponse(next if own else "/", status_code=303)
    secure = request.url.scheme == "https"
    answer.set_cookie(COOKIE, token.strip(), httponly=True, samesite="strict", secure=secure, max_age=30 * 86400)
    return answer


@router.post("/logout")
def sign_out() -> Response:
    answer = RedirectResponse("/", status_code=303)
    answer.delete_cookie(COOKIE, httponly=True, samesite="strict")
    return answer


def _painted(job: Job) -> dict[str, Any]:
    """Values of the form for the result of an attack. Raises ``NotFoundError`` for a judgement."""
    if not isinstance(job.spec, JobSpec):
        raise NotFoundError(f"Job {job.id} is a judgement; the form takes the result of an attack.")
    spec = job.spec
    return {
        "before": spec.object,
        "after": f"{JOB_RESULT}{job.id}",
        "label": spec.goal.label,
        "network": spec.victim.classifier,
        "epsilon": spec.paint.epsilon,
    }


def _choices(services: Services) -> dict[str, Any]:
    """What the forms choose from."""
    return {
        "objects": services.library.objects.all(),
        "labels": {name: shipped.label for name, shipped in shipped_objects().items()},
        "classifiers": services.library.classifiers.all(),
        "endings": ".zip,.glb,.gltf,.fbx,.ply,.stl,.obj",
        "formats": "GLB, FBX, PLY, STL, or a zip of an .obj or .gltf with its textures.",
        "turns": TURNS,
    }


def _list_url(filters: Mapping[str, str], **more: str) -> str:
    return "/jobs?" + urlencode({name: value for name, value in {**filters, **more}.items() if value})


def _rows(
    services: Services,
    *,
    state: str = "",
    label: str = "",
    limit: int = PAGE,
    cursor: str | None = None,
) -> tuple[list[JobRow], str | None]:
    found = services.store.page(
        state=JobState(state) if state else None,
        labels=labels_of([label]) if label else {},
        limit=limit,
        cursor=cursor,
    )
    names = Names(services.library)
    return [_row(services, job, names) for job in found.jobs], found.next_cursor


def _row(services: Services, job: Job, names: Names | None = None) -> JobRow:
    outcome = outcome_of(services.artifacts(job.id)) if RESULT in job.artifacts else None
    return (names or Names(services.library)).row(job).model_copy(update={"outcome": outcome})


def _found(services: Services, job: str) -> Job | None:
    try:
        return services.store.get(job)
    except NotFoundError:
        return None


async def _changes(look: Callable[[], tuple[list[JobRow], str | None]]) -> AsyncIterator[ServerSentEvent]:
    """The list as JSON when it changes: ids of its rows, HTML of new and changed ones, address of the next page."""
    known: dict[str, str] | None = None
    while True:
        with suppress(DatabaseDownError):
            rows, older = await asyncio.to_thread(look)
            versions = {row.id: row.version for row in rows}
            if versions != known:
                changed = [row for row in rows if known is None or known.get(row.id) != row.version]
                html = await asyncio.to_thread(render, "_rows.html", rows=changed)
                yield ServerSentEvent(data=json.dumps({"ids": [*versions], "html": html, "older": older}), event="rows")
            known = versions
        await asyncio.sleep(STREAM_INTERVAL)


def _result(services: Services, job: Job) -> Result | None:
    if RESULT not in job.artifacts:
        return None
    try:
        return Result.model_validate_json(services.artifacts(job.id).read(RESULT))
    except FileNotFoundError:
        return None
    except ValidationError:
        logger.warning("job %s is shown without its result: %s is damaged", job.id, RESULT)
        return None


def _shown(services: Services, row: JobRow, result: Result) -> Shown:
    return present(result, row, names=Names(services.library).classes(result.spec.victim.classifier))
