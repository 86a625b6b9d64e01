"""``trompe token``, and what it means for ``trompe serve``."""

import json
from pathlib import Path

import pytest
from click.testing import CliRunner

from trompe_client.cli import main
from trompe_server.errors import ServiceError
from trompe_server.queue.store import JobStore
from trompe_server.service import serve as serving
from trompe_server.settings import Settings
from trompe_server.storage.tokens import Right, Tokens, hash_secret


def run(data: Path, *words: str) -> tuple[int, str]:
    """Exit status and standard output of ``trompe token`` with these words."""
    result = CliRunner().invoke(main, ["token", *words, "--data", str(data)])
    return result.exit_code, result.stdout if result.exit_code == 0 else result.output


def tokens(data: Path) -> Tokens:
    return Tokens(JobStore(Settings(data=data).database_url).engine)


def test_a_token_is_made_in_a_folder_that_has_none_yet_and_its_secret_is_all_that_is_printed(tmp_path: Path) -> None:
    status, secret = run(tmp_path / "new", "create", "ci", "--right", "read")
    assert status == 0
    found = tokens(tmp_path / "new").by_hash()[hash_secret(secret.strip())]
    assert (found.name, found.right) == ("ci", Right.read)


def test_tokens_are_listed_with_what_became_of_them(tmp_path: Path) -> None:
    assert run(tmp_path, "list") == (0, "")
    made = json.loads(run(tmp_path, "create", "ann", "--json")[1])
    assert made["right"] == "write"
    assert hash_secret(made["secret"]) in tokens(tmp_path).by_hash()
    run(tmp_path, "create", "bob")
    assert run(tmp_path, "revoke", "bob")[0] == 0
    ann, bob = json.loads(run(tmp_path, "list", "--json")[1])
    assert (ann["name"], ann["revoked"], ann["last_used"]) == ("ann", None, None)
    assert bob["revoked"] is not None
    words = run(tmp_path, "list")[1]
    assert "last used never" in words
    assert "revoked 20" in words
    assert made["secret"] not in words


@pytest.mark.parametrize(
    ("words", "status", "reason"),
    [
        (["create", "ann"], 1, "name 'ann' is in use"),
        (["create", "a b"], 2, "not a valid token name"),
        (["create", "eve", "--right", "admin"], 2, "is not one of"),
        (["revoke", "eve"], 1, "no token 'eve'"),
    ],
)
def test_what_cannot_be_done_is_refused_with_a_reason(
    tmp_path: Path, words: list[str], status: int, reason: str
) -> None:
    run(tmp_path, "create", "ann")
    found, said = run(tmp_path, *words)
    assert (found, reason in said) == (status, True), said


def test_a_server_is_seen_by_other_machines_only_while_there_is_a_token_that_is_valid(tmp_path: Path) -> None:
    settings = Settings(data=tmp_path)

    def refused(host: str) -> bool:
        try:
            serving._refuse_public(host, settings)
        except ServiceError:
            return True
        return False

    run(tmp_path, "list")
    assert [refused(host) for host in ("127.0.0.1", "::1", "localhost")] == [False] * 3
    assert [refused(host) for host in ("0.0.0.0", "::", "192.168.1.5", "example.org")] == [True] * 4
    run(tmp_path, "create", "ann", "--right", "read")
    assert not refused("0.0.0.0")
    run(tmp_path, "revoke", "ann")
    assert refused("0.0.0.0")
