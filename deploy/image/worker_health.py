"""Health check of ``trompe worker``: a dispatcher holds the lease, this one or the one that it waits for."""

import sys

from trompe_server.queue.leases import DISPATCHER, lease_holder
from trompe_server.settings import Settings
from trompe_server.storage.database import connect

sys.exit(lease_holder(connect(Settings().database_url), DISPATCHER) is None)
