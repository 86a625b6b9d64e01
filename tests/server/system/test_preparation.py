"""Threads and memory as a process prepares them, in processes of their own: the settings cannot be undone."""

import json
import os
import subprocess
import sys
import textwrap

import pytest

from trompe_server.system.memory import GIB

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


@pytest.mark.thorough
def test_freed_memory_is_kept_but_no_more_than_a_gibibyte() -> None:
    code = """
        import os, numpy as np
        from trompe_server.system.memory import keep_freed_memory
        def pages():
            return int(open("/proc/self/statm").read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
        print(keep_freed_memory())
        arrays = [np.ones(64 * 2**20) for _ in range(3)]
        print(pages())
        del arrays
        print(pages())
        """
    command = [sys.executable, "-c", textwrap.dedent(code)]
    output = subprocess.run(command, check=True, capture_output=True, text=True, timeout=120).stdout
    supported, before, after = output.split()
    if supported == "False":
        pytest.skip("this C library has no mallopt")
    assert int(before) > 1.5 * GIB
    assert 0.4 * GIB < int(after) < 1.25 * GIB
