"""Benches of the surrogate: fidelity, speed, growth. Run them from the repository's root: `python -m bench.fidelity`.

The threads are set here because OpenMP reads its environment once, when torch is first imported.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "2")
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
