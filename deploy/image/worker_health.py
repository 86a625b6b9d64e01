"""Health of an attack worker: whether the database has heard from it of late."""

import socket
import sys

import sqlalchemy as sa

from trompe_server.database import clock, connect
from trompe_server.jobs.tables import workers
from trompe_server.settings import Settings

settings = Settings()
ages = sa.select(clock() - workers.c.seen).where(workers.c.host == socket.gethostname())
with connect(settings.database_url).connect() as connection:
    sys.exit(not any(age < settings.silence for age in connection.scalars(ages)))
