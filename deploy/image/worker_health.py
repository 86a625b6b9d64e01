"""Health check of an attack worker: a recent heartbeat in the database."""

import socket
import sys

import sqlalchemy as sa

from trompe_server.queue.tables import workers
from trompe_server.settings import Settings
from trompe_server.storage.database import clock, connect

settings = Settings()
ages = sa.select(clock() - workers.c.seen).where(workers.c.host == socket.gethostname())
with connect(settings.database_url).connect() as connection:
    sys.exit(not any(age < settings.silence for age in connection.scalars(ages)))
