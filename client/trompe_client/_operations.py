"""Requests with retries, and operations of several requests. Coroutines over a ``Port``."""

import logging
import time
from collections.abc import AsyncGenerator, Callable
from typing import Any, Final, TypeVar

from trompe_client import _core
from trompe_client._core import Request
from trompe_client._errors import ClientError
from trompe_client._plan import Plan, R, Upload
from trompe_client._port import Answer, Port
from trompe_shared.api import Job

LONG: Final = 5.0
"""Seconds of a vain attempt from which its repetition is told."""

T = TypeVar("T")

logger = logging.getLogger("trompe_client")


async def send(port: Port, request: Request[T]) -> T:
    """Send a request, with retries, and parse its answer. Raises ``ClientError``.

    Logs a warning, by default to standard error, before each repetition of an attempt that took long.
    """
    attempt = 0
    while True:
        began = time.monotonic()
        try:
            return await send_once(port, request)
        except ClientError as error:
            pause = port.retries.pause(error, attempt=attempt)
            if pause is None:
                raise
            if time.monotonic() - began > LONG:
                logger.warning("%s Trying again.", error)
        await port.sleep(pause)
        attempt += 1


async def send_once(port: Port, request: Request[T], *, silence: float | None = None) -> T:
    """Send a request and parse its answer. ``silence`` as in ``Port.open``. Raises ``ClientError``."""
    async with port.open(request, silence=silence) as answer:
        await check(answer, request)
        return request.read(await answer.body())


async def check(answer: Answer, request: Request[Any]) -> None:
    """Raise the ``APIError`` of an answer other than success."""
    if answer.status >= 300:
        raise _core.error_from(answer.status, answer.headers, await answer.body(), job_id=request.job_id)


async def planned(port: Port, plan: Callable[[], Plan[R]]) -> R:
    """Make a plan, which reads files, and upload them."""
    return await uploaded(port, await port.off(plan))


async def uploaded(port: Port, plan: Plan[R], ids: dict[Upload, str] | None = None) -> R:
    """Upload a plan's files without an id in ``ids``, and add theirs. Returns the job."""
    ids = {} if ids is None else ids
    for upload in plan.uploads():
        if upload not in ids:
            ids[upload] = (await send(port, _core.store(upload, upload.kind))).id
    return plan.request(ids)


async def stored(port: Port, upload: Callable[[], Upload], kind: type[T]) -> T:
    """Read a file and store it on the server."""
    return await send(port, _core.store(await port.off(upload), kind))


async def pages(port: Port, wanted: list[tuple[str, str]]) -> AsyncGenerator[Job, None]:
    """All jobs of a ``job_filter``, newest first. Pages are fetched when they are reached; the first one is short."""
    cursor: str | None = None
    while True:
        limit = _core.LONG_PAGE if cursor else _core.SHORT_PAGE
        page = await send(port, _core.jobs(wanted, limit=limit, cursor=cursor))
        for job in page.jobs:
            yield job
        cursor = page.next_cursor
        if cursor is None:
            return
