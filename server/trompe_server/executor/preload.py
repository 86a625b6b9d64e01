"""Imported once by the fork server, from which the attack workers of this machine start with torch imported."""

import os
import signal

signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the service, which ends us in order
os.nice(10)  # the API answers at once while attacks compute on all cores

from trompe_server.executor.attempts import prepare  # noqa: E402

prepare(os.environ["TROMPE_PIPELINE"])
