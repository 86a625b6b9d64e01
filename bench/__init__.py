"""Benches, listed in bench/README.md. They compute with two threads, prepared as in attack workers."""

from trompe_server.system.threads import prepare_threads

prepare_threads(2)
