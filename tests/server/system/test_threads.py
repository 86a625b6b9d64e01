"""Threads are prepared before torch reads how many it has and how they wait."""

import json
import os
import subprocess
import sys

SAYS = """
import json, os, sys
import trompe_server.executor.dispatcher, trompe_server.executor.process
too_late = "torch" in sys.modules
from trompe_server.system.threads import prepare_threads
prepare_threads(1)
import torch
print(json.dumps([too_late, torch.get_num_threads(), os.environ["OMP_WAIT_POLICY"], int(os.environ["GOMP_SPINCOUNT"])]))
"""
NAMES = ("OMP_NUM_THREADS", "OMP_WAIT_POLICY", "GOMP_SPINCOUNT")


def prepared(**said: str) -> list[object]:
    """What a process has that imports the attack worker, prepares its threads, and then imports torch."""
    environment = {name: value for name, value in os.environ.items() if name not in NAMES} | said
    told: list[object] = json.loads(subprocess.check_output([sys.executable, "-c", SAYS], env=environment))
    return told


def test_torch_has_as_many_threads_as_it_is_given_and_they_wait_for_a_moment() -> None:
    assert prepared() == [False, 1, "passive", 1000]


def test_what_the_environment_says_stays() -> None:
    said = {"OMP_NUM_THREADS": "2", "OMP_WAIT_POLICY": "active", "GOMP_SPINCOUNT": "7"}
    assert prepared(**said) == [False, 2, "active", 7]
