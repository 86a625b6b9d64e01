"""The contract: complete, with examples that hold; whatever is sent, no 5xx, and answers as the contract says."""

import json
import random
import re
import warnings
from contextlib import suppress
from typing import Any

import pytest
import schemathesis
from hypothesis import HealthCheck, given, settings
from hypothesis.errors import Unsatisfiable
from jsonschema_rs import validator_for
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

Contract = dict[str, Any]


@pytest.fixture
def contract(api: Api) -> Any:
    return api.get("/openapi.json").json()


def check(contract: Contract, schema: Any, value: Any) -> None:
    """Fail unless ``value`` fits a schema of the contract."""
    validator_for(schema | {"components": contract["components"]}).validate(value)


def operations(contract: Contract) -> list[tuple[str, str, Any]]:
    return [(path, method, spec) for path, methods in contract["paths"].items() for method, spec in methods.items()]


def test_the_documentation_works_without_any_other_host(api: Api, contract: Contract) -> None:
    page = api.get("/docs")
    assert "://" not in page.text
    assert "<script" not in page.text
    for path, method, _ in operations(contract):
        assert f"<b>{method.upper()}</b> <code>{path}</code>" in page.text
    assert "script-src 'self'; style-src 'self'" in page.headers["content-security-policy"]
    assert contract["components"]["schemas"]["JobSpec"]["examples"][0]["object"] == "mug"


def test_every_operation_is_described_and_says_how_it_refuses(contract: Contract) -> None:
    for path, method, spec in operations(contract):
        assert spec["description"], (method, path)
        assert "application/problem+json" in spec["responses"]["4XX"]["content"], (method, path)


def test_the_contract_says_what_needs_a_token(contract: Contract) -> None:
    assert contract["components"]["securitySchemes"]["token"] == {"type": "http", "scheme": "bearer"}
    free = {path for path, _, spec in operations(contract) if spec.get("security") == []}
    assert free == {"/healthz", "/readyz"}


def test_every_answer_with_content_has_an_example_that_fits_its_schema(contract: Contract) -> None:
    for path, method, spec in operations(contract):
        for status, answer in spec["responses"].items():
            for kind, content in answer.get("content", {}).items():
                if kind not in {"application/json", "application/problem+json"}:
                    continue
                assert "example" in content, (method, path, status)
                check(contract, content["schema"], content["example"])
    events = contract["paths"]["/v1/jobs/{job}/events"]["get"]["responses"]["200"]["content"]["text/event-stream"]
    (data,) = re.findall("data: (.*)", events["example"])
    check(contract, {"$ref": "#/components/schemas/Event"}, json.loads(data))


def test_every_example_of_a_job_can_be_submitted(api: Api, contract: Contract) -> None:
    body = contract["paths"]["/v1/jobs"]["post"]["requestBody"]["content"]["application/json"]
    assert set(body["examples"]) == {"shortest", "labelled", "targeted"}
    for name, example in body["examples"].items():
        answer = api.post("/v1/jobs", json=example["value"])
        assert answer.status_code == 201, (name, answer.text)


# Whatever is sent

RESULT = json.dumps(examples.RESULT).encode()
CHECKS = [
    schemathesis.checks.not_a_server_error,
    content_type_conformance,
    response_headers_conformance,
    response_schema_conformance,
    status_code_conformance,
]


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
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        schema: Any = schemathesis.openapi.from_asgi("/openapi.json", stocked.app)
    seen = set()
    for operation in (found.ok() for found in schema.get_all_operations()):
        if mode is GenerationMode.POSITIVE or can_be_wrong(operation):
            seen |= fuzz(operation, stocked, mode, tries=20 if right and mode is GenerationMode.POSITIVE else 8)
    assert ({200, 404} if mode is GenerationMode.POSITIVE else {422}) <= seen
    assert (403 in seen) == (right is Right.read)


def can_be_wrong(operation: Any) -> bool:
    """Whether it takes more than plain text, of which none is wrong: the search for one is long."""
    raw = operation.definition.raw
    schemas = [each["schema"] for each in raw.get("parameters", [])]
    return "requestBody" in raw or any(schema.get("type") != "string" for schema in schemas)


def fuzz(operation: Any, api: Api, mode: GenerationMode, *, tries: int) -> set[int]:
    """Send made-up requests of one operation, half of them about a job that is there; statuses of the answers."""
    request = JobRequest.of("mug", label="mug")
    job, seen, luck = api.services.store.create(request)[0].id, set(), random.Random(0)
    api.end(job, JobState.succeeded, result__json=RESULT, digits__txt=b"0123456789")

    @settings(max_examples=tries, derandomize=True, database=None, suppress_health_check=list(HealthCheck))
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
