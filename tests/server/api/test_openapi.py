"""The contract: complete, with examples that hold."""

import json
import re

import pytest
from jsonschema_rs import validator_for


@pytest.fixture
def contract(api):
    return api.get("/openapi.json").json()


def check(contract, schema, value):
    """Fail unless ``value`` fits a schema of the contract."""
    validator_for(schema | {"components": contract["components"]}).validate(value)


def operations(contract):
    return [(path, method, spec) for path, methods in contract["paths"].items() for method, spec in methods.items()]


def test_the_documentation_works_without_any_other_host(api, contract):
    page = api.get("/docs")
    assert "://" not in page.text
    assert "script src" not in page.text
    assert page.headers["content-security-policy"].count("'sha256-") == 2
    assert contract["components"]["schemas"]["JobSpec"]["examples"][0]["object"] == "mug"


def test_every_operation_is_described_and_says_how_it_refuses(contract):
    for path, method, spec in operations(contract):
        assert spec["description"], (method, path)
        assert "application/problem+json" in spec["responses"]["4XX"]["content"], (method, path)


def test_the_contract_says_what_needs_a_token(contract):
    assert contract["components"]["securitySchemes"]["token"] == {"type": "http", "scheme": "bearer"}
    free = {path for path, _, spec in operations(contract) if spec.get("security") == []}
    assert free == {"/healthz", "/readyz"}


def test_every_answer_with_content_has_an_example_that_fits_its_schema(contract):
    for path, method, spec in operations(contract):
        for status, answer in spec["responses"].items():
            for kind, content in answer.get("content", {}).items():
                if kind not in {"application/json", "application/problem+json"}:
                    continue
                assert "example" in content, (method, path, status)
                check(contract, content["schema"], content["example"])


def test_every_example_of_a_job_can_be_submitted(api, contract):
    body = contract["paths"]["/v1/jobs"]["post"]["requestBody"]["content"]["application/json"]
    assert set(body["examples"]) == {"shortest", "labelled", "targeted"}
    for name, example in body["examples"].items():
        answer = api.post("/v1/jobs", json=example["value"])
        assert answer.status_code == 201, (name, answer.text)


def test_the_event_of_the_example_is_one(contract):
    answer = contract["paths"]["/v1/jobs/{job}/events"]["get"]["responses"]["200"]
    example = answer["content"]["text/event-stream"]["example"]
    data = json.loads(re.search("data: (.*)", example)[1])
    check(contract, {"$ref": "#/components/schemas/Event"}, data)
