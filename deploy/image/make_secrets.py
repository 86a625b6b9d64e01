"""Makes the missing passwords of a deployment, each in the volume of its readers."""

import os
import secrets
from pathlib import Path

SHARED = 0o640  # PostgreSQL and the object store read theirs as members of our group
PRIVATE = 0o600  # required by libpq


def keep(file: Path, text: str, mode: int) -> None:
    """Write a file with its mode, atomically."""
    part = file.with_suffix(".part")
    with os.fdopen(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, mode), "w") as stream:
        stream.write(text)
    part.chmod(mode)
    part.rename(file)


def secret(file: Path) -> str:
    """Read the secret in the file; make it first if it is missing."""
    if not file.exists():
        keep(file, secrets.token_urlsafe(32), SHARED)
    return file.read_text()


def main() -> None:
    """Make all secrets."""
    password = secret(Path("/secrets/database/database-password"))
    keep(Path("/secrets/database/pgpass"), f"*:*:*:*:{password}\n", PRIVATE)
    key = secret(Path("/secrets/objects/objects-password"))
    credentials = f"[default]\naws_access_key_id = trompe\naws_secret_access_key = {key}\n"
    keep(Path("/secrets/objects/credentials"), credentials, PRIVATE)
    secret(Path("/secrets/cluster/token"))


if __name__ == "__main__":
    main()
