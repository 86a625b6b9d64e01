"""Memory that is freed and wanted again. Each test looks at a process of its own: there is no way back."""

import subprocess
import sys
import textwrap

import pytest

from trompe_server.memory import GIB


def run(code: str) -> str:
    """What ``code`` prints in a new process."""
    command = [sys.executable, "-c", textwrap.dedent(code)]
    return subprocess.run(command, check=True, capture_output=True, text=True, timeout=120).stdout


def test_freed_memory_soon_serves_the_next_array() -> None:
    said, pages = run(
        """
        import resource, torch
        from trompe_server.memory import keep_freed_memory
        print(keep_freed_memory())
        for _ in range(10):
            torch.ones(25 * 2**20)
        before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
        torch.ones(25 * 2**20)
        print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
        """
    ).split()
    if said == "False":
        pytest.skip("this C library has no mallopt")
    assert int(pages) < 1000  # of the 25 600 that it fills


def test_no_more_than_a_gibibyte_is_kept() -> None:
    said, before, after = run(
        """
        import os, numpy as np
        from trompe_server.memory import keep_freed_memory
        def pages():
            return int(open("/proc/self/statm").read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
        print(keep_freed_memory())
        arrays = [np.ones(64 * 2**20) for _ in range(3)]
        print(pages())
        del arrays
        print(pages())
        """
    ).split()
    if said == "False":
        pytest.skip("this C library has no mallopt")
    assert int(before) > 1.5 * GIB
    assert int(after) < 1.25 * GIB
