"""Bearer tokens. The database stores only hashes.

A secret has 256 random bits, so one round of SHA-256 protects it: no dictionary contains it. Revoked tokens stay in the
table: their names remain taken, and a service does not become open again when its last token is revoked.
"""

import hashlib
import logging
import re
import secrets
import time
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import StrEnum
from typing import Any, Final

import sqlalchemy as sa
from sqlalchemy.exc import IntegrityError, SQLAlchemyError

from trompe_server.errors import ConflictError, NotFoundError
from trompe_server.storage.database import DatabaseDownError, clock, write
from trompe_shared.errors import SpecError

logger = logging.getLogger(__name__)

PREFIX: Final = "trompe_"
"""Prefix of every secret, for scanners that look for leaked secrets."""
NOTE_INTERVAL: Final = 60.0
"""Least time between two updates of ``last_used``, seconds."""
_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.@\-]{0,62}")

metadata = sa.MetaData()
_tokens = sa.Table(
    "tokens",
    metadata,
    sa.Column("name", sa.String(63), primary_key=True),
    sa.Column("sha256", sa.String(64), unique=True, nullable=False),
    sa.Column("may", sa.String(5), nullable=False),
    sa.Column("created", sa.Double, nullable=False),
    sa.Column("last_used", sa.Double),
    sa.Column("revoked", sa.Double),
)


class Right(StrEnum):
    """Right of a token. ``write`` includes ``read``."""

    read = "read"
    write = "write"


@dataclass(frozen=True)
class Token:
    """A token without its secret. ``last_used`` is exact to about a minute."""

    name: str
    right: Right
    created: datetime
    last_used: datetime | None
    revoked: datetime | None


def hash_secret(secret: str) -> str:
    """SHA-256 of a secret, in hex: the form stored in the database."""
    return hashlib.sha256(secret.encode()).hexdigest()


class Tokens:
    """The tokens in the database of ``engine``. Safe to use from many threads and processes."""

    def __init__(self, engine: sa.Engine) -> None:
        self._engine = engine
        self._noted: dict[str, float] = {}

    def create(self, name: str, right: Right) -> str:
        """Create a token and return its secret, which is not stored.

        Raises ``SpecError`` for an invalid name and ``ConflictError`` for one already in use.
        """
        if not _NAME.fullmatch(name):
            raise SpecError(
                f"{name!r} is not a valid token name: use up to 63 letters, digits, '.', '_', '-' and '@', "
                "beginning with a letter or a digit."
            )
        secret = PREFIX + secrets.token_urlsafe(32)
        row = {"name": name, "sha256": hash_secret(secret), "may": right.value, "created": clock()}
        try:
            with write(self._engine) as connection:
                connection.execute(_tokens.insert().values(row))
        except IntegrityError as error:
            raise ConflictError(f"The name {name!r} is in use or was used before. Choose another name.") from error
        return secret

    def all(self) -> list[Token]:
        """All tokens, revoked ones included, oldest first."""
        return list(self.by_hash().values())

    def by_hash(self) -> Mapping[str, Token]:
        """The same by the hash of their secret."""
        with self._engine.connect() as connection:
            rows = connection.execute(sa.select(_tokens).order_by(_tokens.c.created))
            return {row.sha256: _token(row) for row in rows}

    def revoke(self, name: str) -> None:
        """Revoke a token; no effect on a revoked one. Raises ``NotFoundError``."""
        if name not in {token.name for token in self.all()}:
            raise NotFoundError(f"There is no token {name!r}. `trompe token list` lists all tokens.")
        valid = (_tokens.c.name == name) & _tokens.c.revoked.is_(None)
        with write(self._engine) as connection:
            connection.execute(_tokens.update().where(valid).values(revoked=clock()))

    def to_be_noted(self, name: str) -> bool:
        """Return whether ``last_used`` of the token ``name`` needs an update."""
        return time.monotonic() - self._noted.get(name, -NOTE_INTERVAL) >= NOTE_INTERVAL

    def note_used(self, name: str) -> None:
        """Update ``last_used``. A failure is only logged."""
        self._noted[name] = time.monotonic()
        try:
            with write(self._engine) as connection:
                connection.execute(_tokens.update().where(_tokens.c.name == name).values(last_used=clock()))
        except (SQLAlchemyError, DatabaseDownError):
            logger.warning("cannot update the last use of token %s", name, exc_info=True)


def _token(row: "sa.Row[Any]") -> Token:
    times = (None if at is None else datetime.fromtimestamp(at, UTC) for at in (row.last_used, row.revoked))
    return Token(row.name, Right(row.may), datetime.fromtimestamp(row.created, UTC), *times)
