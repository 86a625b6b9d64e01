"""Benches of the surrogate: fidelity, speed, growth. Run them from the repository's root: `python -m bench.fidelity`.

They have two threads, prepared as those of attack workers are.
"""

from trompe_server.threads import prepare_threads

prepare_threads(2)
