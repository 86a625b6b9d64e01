"""The contract: complete, with examples that hold."""

import json
import re
from typing import Any

import pytest
from jsonschema_rs import validator_for

from tests.server.api.conftest import Api

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
