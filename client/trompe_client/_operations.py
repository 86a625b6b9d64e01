"""Requests that are sent again where that may help, and what takes several of them. Coroutines over a ``Port``."""

from collections.abc import AsyncGenerator, Callable
from typing import Any, TypeVar

from trompe_client import _core
from trompe_client._core import JobFilter, Request
from trompe_client._errors import ClientError
from trompe_client._plan import AttackPlan, Upload
from trompe_client._port import Answer, Port
from trompe_shared.api import Job, JobRequest

T = TypeVar("T")


async def send(port: Port, request: Request[T]) -> T:
    """Send a request, again while there is hope, and read its answer. Raises ``ClientError``."""
    attempt = 0
    while True:
        try:
            return await send_once(port, request)
        except ClientError as error:
            pause = port.retries.pause(error, attempt=attempt)
            if pause is None:
                raise
        await port.sleep(pause)
        attempt += 1


async def send_once(port: Port, request: Request[T]) -> T:
    """Send a request and read its answer. Raises ``ClientError``."""
    async with port.open(request) as answer:
        await check(answer, request)
        return request.read(await answer.body())


async def check(answer: Answer, request: Request[Any]) -> None:
    """Raise the error that a refusing answer stands for."""
    if answer.status >= 300:
        raise _core.error_from(answer.status, answer.headers, await answer.body(), job_id=request.job_id)


async def planned(port: Port, plan: Callable[[], AttackPlan]) -> JobRequest:
    """Make a plan, which reads files, and upload them."""
    return await uploaded(port, await port.off(plan))


async def uploaded(port: Port, plan: AttackPlan) -> JobRequest:
    """Upload a plan's files; gives the job, which names them by id."""

    async def stored(request: Callable[[Upload], Request[Any]], source: Upload | str) -> str:
        return source if isinstance(source, str) else str((await send(port, request(source))).id)

    return plan.spec(
        object=await stored(_core.upload_object, plan.object),
        classifier=await stored(_core.upload_classifier, plan.classifier),
        ensemble=[await stored(_core.upload_classifier, member) for member in plan.ensemble],
        judges=[await stored(_core.upload_classifier, judge) for judge in plan.judges],
        background=[await stored(_core.upload_background, picture) for picture in plan.backgrounds],
        masks={texture: await stored(_core.upload_background, picture) for texture, picture in plan.masks.items()},
    )


async def uploaded_file(port: Port, upload: Callable[[], Upload], request: Callable[[Upload], Request[T]]) -> T:
    """Read a file and store it on the server."""
    return await send(port, request(await port.off(upload)))


async def pages(port: Port, wanted: JobFilter) -> AsyncGenerator[Job, None]:
    """All jobs that are as wanted, newest first; a page is fetched when it is reached, and the first one is short."""
    cursor: str | None = None
    while True:
        limit = _core.LONG_PAGE if cursor else _core.SHORT_PAGE
        page = await send(port, _core.jobs(wanted, limit=limit, cursor=cursor))
        for job in page.jobs:
            yield job
        cursor = page.next_cursor
        if cursor is None:
            return
