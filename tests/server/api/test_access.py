"""Who is let in: tokens, what they are good for, how fast, and which browsers."""

import asyncio
import re
from dataclasses import replace
from functools import partial
from itertools import product
from unittest.mock import Mock

import httpx
import pytest
import sqlalchemy as sa
from hypothesis import given
from hypothesis import strategies as st

from tests.server.api.conftest import Api
from trompe_server.api import guard, rate
from trompe_server.api.guard import OPEN_PATHS
from trompe_server.api.rate import BURST, RateLimit
from trompe_server.errors import ConflictError, NotFoundError
from trompe_server.service.app import create_app
from trompe_server.storage.tokens import Right
from trompe_shared.errors import SpecError


def routes(api: Api) -> list[tuple[str, str]]:
    """Method and path of every operation, with made-up ids."""
    paths = api.get("/openapi.json").json()["paths"]
    return [(method.upper(), re.sub(r"{\w+}", "x", path)) for path, methods in paths.items() for method in methods]


def test_once_there_is_a_token_everything_but_the_open_paths_asks_for_one(api: Api) -> None:
    found = routes(api)
    api.token("ci", Right.read)
    for method, path in [*found, ("GET", "/"), ("GET", "/nothing"), ("GET", "/jobs"), ("GET", "/static")]:
        answer = api.request(method, path)
        if path in OPEN_PATHS:
            assert answer.status_code < 400
        else:
            refusal = api.problem(answer, 401)
            assert refusal["type"] == "urn:trompe:unauthorized"
            assert answer.headers["www-authenticate"].startswith('Bearer realm="trompe"')


def test_a_token_that_may_read_cannot_write_anything_and_one_that_may_write_can_do_both(api: Api) -> None:
    found = routes(api)
    api.headers = api.token("viewer", Right.read)
    writes = [route for route in found if route[0] != "GET" and route[1] not in guard.STORES_NOTHING]
    assert {method for method, _ in writes} == {"POST", "DELETE"}
    for method, path in writes:
        refusal = api.problem(api.request(method, path), 403)
        assert "'viewer' may only read" in refusal["detail"]
    for method, path in set(found) - set(writes):
        expected = {422} if path in guard.STORES_NOTHING else {200, 404}
        assert api.request(method, path).status_code in expected
    api.headers = api.token("ci", Right.write)
    assert {api.request(method, path).status_code for method, path in writes} <= {404, 422}
    assert api.get("/v1/jobs").status_code == 200


def test_what_is_no_token_is_refused(api: Api) -> None:
    api.token("ci", Right.read)
    headers = ["Bearer trompe_guess", "Bearer ", "Bearer", "Basic dXNlcjpwYXNz", "trompe_guess", "bearer \N{SNOWMAN}"]
    for header in headers:
        api.problem(api.get("/v1/jobs", headers={"Authorization": header.encode()}), 401, header)


def test_a_revoked_token_opens_nothing_and_the_service_stays_closed(api: Api) -> None:
    header = api.token("ci", Right.write)
    assert api.get("/v1/jobs", headers=header).status_code == 200
    api.services.tokens.revoke("ci")
    answer = api.get("/v1/jobs", headers=header)
    assert "revoked" in api.problem(answer, 401)["detail"]
    assert 'error="invalid_token"' in answer.headers["www-authenticate"]
    api.problem(api.get("/v1/jobs"), 401)


def test_no_host_and_no_path_is_a_way_around_the_token(api: Api) -> None:
    api.token("ci", Right.read)
    hosts = ["x/docs?", "x/docs#", "x/static/", "trompe/healthz?a=", "@/docs?", "[x/docs?"]
    paths = ["/v1/jobs", "/static/../v1/jobs", "/docs/../v1/jobs", "//v1/jobs", "/docs%2F..%2Fv1"]
    for host, path in product(hosts, paths):
        answer = api.get(path, headers={"Host": host})
        assert answer.status_code in {401, 404}, (host, path)
        assert 'jobs":' not in answer.text, (host, path)


def test_a_browser_that_signed_in_shows_its_token_in_a_cookie(api: Api) -> None:
    secret = api.token("ann", Right.write)["Authorization"].removeprefix("Bearer ")
    cookie = {"Cookie": f"trompe_token={secret}"}
    assert api.get("/v1/jobs", headers=cookie).status_code == 200
    api.problem(api.get("/v1/jobs", headers={"Cookie": "trompe_token=guess"}), 401)
    api.problem(api.get("/v1/jobs", headers=cookie | {"Authorization": "Bearer guess"}), 401)
    for origin, status in ({}, 403), ({"Origin": "https://evil.example"}, 403), ({"Origin": "http://trompe"}, 422):
        api.problem(api.post("/v1/jobs", json={}, headers=cookie | origin), status)


def test_the_database_holds_no_secret(api: Api) -> None:
    header = api.token("ci", Right.write)
    secret = header["Authorization"].removeprefix("Bearer ")
    assert re.fullmatch(r"trompe_[\w-]{43}", secret)
    with api.services.store.engine.connect() as connection:
        row = connection.execute(sa.text("SELECT * FROM tokens")).one()
    assert secret not in str(row)
    assert secret.removeprefix("trompe_") not in str(row)


def test_it_is_noted_when_a_token_was_used_but_not_at_each_request(api: Api, monkeypatch: pytest.MonkeyPatch) -> None:
    header = api.token("ci", Right.read)
    assert api.services.tokens.all()[0].last_used is None
    api.get("/v1/jobs", headers=header)
    used = api.services.tokens.all()[0].last_used
    assert used is not None
    api.get("/v1/jobs", headers=header)
    assert api.services.tokens.all()[0].last_used == used


def test_names_of_tokens_are_taken_for_good_and_are_plain(api: Api) -> None:
    tokens = api.services.tokens
    tokens.create("ci", Right.read)
    tokens.revoke("ci")
    tokens.revoke("ci")
    with pytest.raises(ConflictError, match="'ci' is in use or was used before"):
        tokens.create("ci", Right.write)
    with pytest.raises(NotFoundError, match="no token 'cd'"):
        tokens.revoke("cd")
    for name in ("", "-x", "a b", "x" * 64, "a\n"):
        with pytest.raises(SpecError, match="not a valid token name"):
            tokens.create(name, Right.read)
    assert [(each.name, each.right, each.revoked is None) for each in tokens.all()] == [("ci", Right.read, False)]


def limit(api: Api, monkeypatch: pytest.MonkeyPatch, per_second: float) -> None:
    """Limit the rate of requests; time stands still."""
    monkeypatch.setattr(guard, "RateLimit", partial(RateLimit, clock=lambda: 0.0))
    settings = api.services.settings.model_copy(update={"rate_limit": per_second})
    api.services = replace(api.services, settings=settings)
    api.app = create_app(api.services)


def test_a_client_that_asks_too_often_is_told_when_to_come_back(api: Api, monkeypatch: pytest.MonkeyPatch) -> None:
    limit(api, monkeypatch, 0.5)
    answers = [api.get("/v1/jobs") for _ in range(int(0.5 * BURST) + 1)]
    assert [answer.status_code for answer in answers[:-1]] == [200] * (len(answers) - 1)
    assert "Too many requests; retry in" in api.problem(answers[-1], 429)["detail"]
    assert answers[-1].headers["retry-after"] == "2"
    assert api.get("/healthz").status_code == 200
    api.headers = api.token("ci", Right.read)
    assert api.get("/v1/jobs").status_code == 200


def test_guessing_tokens_is_limited_by_address(api: Api, monkeypatch: pytest.MonkeyPatch) -> None:
    api.token("ci", Right.read)
    limit(api, monkeypatch, 0.1)
    guesses = [api.get("/v1/jobs", headers={"Authorization": f"Bearer trompe_{n}"}).status_code for n in range(4)]
    assert guesses == [401, 401, 429, 429]


@given(st.lists(st.floats(0, 5), min_size=1, max_size=60), st.sampled_from([0.5, 1.0, 20.0]))
def test_no_client_is_served_more_than_its_rate_and_one_burst(pauses: list[float], per_second: float) -> None:
    now = 0.0
    limit = RateLimit(per_second, clock=lambda: now)
    served = 0
    for pause in pauses:
        now += pause
        wait = limit.wait("a")
        assert wait <= 1 / per_second + 1e-6
        served += wait == 0.0
        assert served <= per_second * (now + BURST) + 1e-6
        if wait:
            now += wait + 1e-9
            assert limit.wait("a") == 0.0
            served += 1


def test_no_limit_is_no_limit_and_old_clients_are_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    unlimited = RateLimit(0)
    assert {unlimited.wait("a") for _ in range(10_000)} == {0.0}
    monkeypatch.setattr(rate, "MAX_CLIENTS", 3)
    limit = RateLimit(1 / BURST, clock=lambda: 0.0)
    assert [limit.wait(client) == 0.0 for client in "abcd"] == [True] * 4
    assert limit.wait("d") > 0.0
    assert limit.wait("a") == 0.0


def test_a_page_of_another_site_can_neither_write_nor_read(api: Api) -> None:
    for origin in ("https://evil.example", "null", "http://trompe:8000"):
        refusal = api.problem(api.post("/v1/jobs", json={}, headers={"Origin": origin}), 403)
        assert refusal["type"] == "urn:trompe:other-origin"
        assert refusal["detail"].startswith(f"Pages of {origin} may not write at trompe. A proxy must pass on")
    api.problem(api.post("/v1/jobs", json={}, headers={"Origin": "http://trompe"}), 422)
    evil = {"Origin": "https://evil.example"}
    assert not [name for name in api.get("/v1/jobs", headers=evil).headers if name.startswith("access-control")]
    api.problem(api.request("OPTIONS", "/v1/jobs", headers=evil | {"Access-Control-Request-Method": "POST"}), 405)


@pytest.mark.parametrize("header", [{"Host": "[x"}, {"Origin": "http://[x"}])
def test_an_address_that_is_none_is_refused(api: Api, header: dict[str, str]) -> None:
    api.problem(api.post("/v1/jobs", json={}, headers=header), 400)


def test_without_tokens_a_public_name_for_this_machine_is_refused(api: Api) -> None:
    for host in ("evil.example", "127.0.0.1.evil.example:8000"):
        assert "answers by its address only" in api.problem(api.get("/v1/jobs", headers={"Host": host}), 403)["detail"]
    for host in ("127.0.0.1:8000", "localhost", "[::1]:8000", "trompe"):
        assert api.get("/v1/jobs", headers={"Host": host}).status_code == 200
    header = api.token("ci", Right.read)
    assert api.get("/v1/jobs", headers=header | {"Host": "trompe.example.org"}).status_code == 200


def test_every_answer_tells_browsers_to_be_strict(api: Api) -> None:
    for path in ("/v1/jobs", "/nothing", "/healthz", "/docs", "/openapi.json"):
        headers = api.get(path).headers
        assert "default-src 'none'" in headers["content-security-policy"]
        assert "frame-ancestors 'none'" in headers["content-security-policy"]
        assert headers["x-content-type-options"] == "nosniff"
        assert headers["referrer-policy"] == ("same-origin" if path == "/docs" else "no-referrer")
        assert headers["cache-control"] == "no-store"


def test_tokens_are_looked_up_once_for_many_requests_at_one_time(api: Api, monkeypatch: pytest.MonkeyPatch) -> None:
    api.headers = api.token("ci", Right.read)
    monkeypatch.setattr("trompe_server.api.guard.FRESH", 600.0)
    look_up = Mock(side_effect=api.services.tokens.by_hash)
    monkeypatch.setattr(api.services.tokens, "by_hash", look_up)

    async def many() -> list[httpx.Response]:
        async with api.connect() as client:
            return await asyncio.gather(*(client.get("/v1/jobs") for _ in range(30)))

    assert {answer.status_code for answer in asyncio.run(many())} == {200}
    assert look_up.call_count == 1
