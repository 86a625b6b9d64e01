"""Whatever is sent, whether the contract allows it or not: no 5xx, and answers as the contract says."""

import json
import random
import warnings
from contextlib import suppress
from typing import Any

import pytest
import schemathesis
from hypothesis import HealthCheck, given, settings
from hypothesis.errors import Unsatisfiable
from schemathesis import GenerationMode
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    response_headers_conformance,
    response_schema_conformance,
    status_code_conformance,
)

from tests.server.api.conftest import Api
from trompe_server.api import examples
from trompe_server.storage.tokens import Right
from trompe_shared.api import JobRequest, JobState

RESULT = json.dumps(examples.RESULT).encode()
CHECKS = [
    schemathesis.checks.not_a_server_error,
    content_type_conformance,
    response_headers_conformance,
    response_schema_conformance,
    status_code_conformance,
]


def schema_of(api: Api) -> Any:
    """The contract as schemathesis reads it."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return schemathesis.openapi.from_asgi("/openapi.json", api.app)


@pytest.mark.parametrize("mode", [GenerationMode.POSITIVE, GenerationMode.NEGATIVE], ids=["allowed", "wrong"])
@pytest.mark.parametrize(
    "right",
    [
        pytest.param(None, id="open"),
        pytest.param(Right.read, id="reader", marks=pytest.mark.thorough),
        pytest.param(Right.write, id="writer", marks=pytest.mark.thorough),
    ],
)
def test_nothing_that_is_sent_is_a_server_error(stocked: Api, right: Right | None, mode: GenerationMode) -> None:
    if right is not None:
        stocked.headers = stocked.token("fuzz", right)
    schema = schema_of(stocked)
    seen = set()
    for operation in (found.ok() for found in schema.get_all_operations()):
        if mode is GenerationMode.POSITIVE or can_be_wrong(operation):
            seen |= fuzz(operation, stocked, mode)
    assert ({200, 404} if mode is GenerationMode.POSITIVE else {422}) <= seen
    assert (403 in seen) == (right is Right.read)


def can_be_wrong(operation: Any) -> bool:
    """Whether it takes more than plain text, of which none is wrong: the search for one is long."""
    raw = operation.definition.raw
    schemas = [each["schema"] for each in raw.get("parameters", [])]
    return "requestBody" in raw or any(schema.get("type") != "string" for schema in schemas)


def fuzz(operation: Any, api: Api, mode: GenerationMode) -> set[int]:
    """Send made-up requests of one operation, half of them about a job that is there; statuses of the answers."""
    request = JobRequest.of("mug", label="mug")
    job, seen, luck = api.services.store.create(request)[0].id, set(), random.Random(0)
    api.end(job, JobState.succeeded, result__json=RESULT, digits__txt=b"0123456789")

    @settings(
        max_examples=20 if mode is GenerationMode.POSITIVE else 8,
        derandomize=True,
        database=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(operation.as_strategy(generation_mode=mode))
    def send(case: Any) -> None:
        if "job" in case.path_parameters and luck.random() < 0.5:
            case.path_parameters["job"] = job
        answer = case.call(headers=api.headers)
        seen.add(answer.status_code)
        case.validate_response(answer, checks=CHECKS)

    with suppress(Unsatisfiable):  # there is nothing wrong to send to an operation that takes nothing
        send()
    return seen
