"""Who may come in: bearer tokens, of which the database keeps hashes alone.

A secret has 256 random bits, so that one round of SHA-256 is enough to keep it: there is nothing to guess by a
dictionary. Revoked tokens stay in the table: their names remain taken, and a service that had tokens once never opens
itself again because the last of them is gone.
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

from trompe_server.database import DatabaseDownError, clock, write
from trompe_server.errors import ConflictError, NotFoundError
from trompe_shared.errors import SpecError

__all__ = ["Right", "Token", "Tokens", "hash_secret", "migrate"]

logger = logging.getLogger(__name__)

PREFIX: Final = "trompe_"
"""Begins every secret, so that scanners for leaked secrets can tell one."""
NOTE_INTERVAL: Final = 60.0
"""Seconds between two notes that a token was used."""
_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.@\-]{0,62}")

_metadata = sa.MetaData()
_tokens = sa.Table(
    "tokens",
    _metadata,
    sa.Column("name", sa.String(63), primary_key=True),
    sa.Column("sha256", sa.String(64), unique=True, nullable=False),
    sa.Column("may", sa.String(5), nullable=False),
    sa.Column("created", sa.Double, nullable=False),
    sa.Column("last_used", sa.Double),
    sa.Column("revoked", sa.Double),
)


class Right(StrEnum):
    """What a token is good for; who may write may read, too."""

    read = "read"
    write = "write"


@dataclass(frozen=True)
class Token:
    """A token without its secret. ``last_used`` is right to a minute or so."""

    name: str
    right: Right
    created: datetime
    last_used: datetime | None
    revoked: datetime | None


def migrate(connection: sa.Connection) -> None:
    """Make the table where it is missing."""
    _metadata.create_all(connection)


def hash_secret(secret: str) -> str:
    """What the database keeps of a secret: its SHA-256, in hex."""
    return hashlib.sha256(secret.encode()).hexdigest()


class Tokens:
    """The tokens in the database of ``engine``. Safe to use from many threads and processes."""

    def __init__(self, engine: sa.Engine) -> None:
        self._engine = engine
        self._noted: dict[str, float] = {}

    def create(self, name: str, right: Right) -> str:
        """A new token; its secret is returned here and never again.

        Raises ``SpecError`` for a name that cannot be one and ``ConflictError`` for one that is taken.
        """
        if not _NAME.fullmatch(name):
            raise SpecError(
                f"{name!r} cannot be the name of a token: use up to 63 letters, digits, '.', '_', '-' and '@', "
                "beginning with a letter or a digit."
            )
        secret = PREFIX + secrets.token_urlsafe(32)
        row = {"name": name, "sha256": hash_secret(secret), "may": right.value, "created": clock()}
        try:
            with write(self._engine) as connection:
                connection.execute(_tokens.insert().values(row))
        except IntegrityError as error:
            raise ConflictError(f"There is, or was, a token {name!r}; choose another name.") from error
        return secret

    def all(self) -> list[Token]:
        """All tokens, those that were revoked too, oldest first."""
        with self._engine.connect() as connection:
            return [_token(row) for row in connection.execute(sa.select(_tokens).order_by(_tokens.c.created))]

    def by_hash(self) -> Mapping[str, Token]:
        """All tokens by the hash of their secret."""
        with self._engine.connect() as connection:
            return {row.sha256: _token(row) for row in connection.execute(sa.select(_tokens))}

    def revoke(self, name: str) -> None:
        """Make a token worthless; one that is so already stays as it is. Raises ``NotFoundError``."""
        if name not in {token.name for token in self.all()}:
            raise NotFoundError(f"There is no token {name!r}. `trompe token list` shows those there are.")
        valid = (_tokens.c.name == name) & _tokens.c.revoked.is_(None)
        with write(self._engine) as connection:
            connection.execute(_tokens.update().where(valid).values(revoked=clock()))

    def to_be_noted(self, name: str) -> bool:
        """Whether the last note that the token ``name`` was used is so old that another one is due."""
        return time.monotonic() - self._noted.get(name, -NOTE_INTERVAL) >= NOTE_INTERVAL

    def note_used(self, name: str) -> None:
        """Note that a token was used just now. Where that fails the log says so: it stops nobody's work."""
        self._noted[name] = time.monotonic()
        try:
            with write(self._engine) as connection:
                connection.execute(_tokens.update().where(_tokens.c.name == name).values(last_used=clock()))
        except (SQLAlchemyError, DatabaseDownError):
            logger.warning("it could not be noted that the token %s was used", name, exc_info=True)


def _token(row: "sa.Row[Any]") -> Token:
    times = (None if at is None else datetime.fromtimestamp(at, UTC) for at in (row.last_used, row.revoked))
    return Token(row.name, Right(row.may), datetime.fromtimestamp(row.created, UTC), *times)
