"""Memory that is freed and kept, measured in a process of its own: the setting cannot be undone."""

import subprocess
import sys
import textwrap

import pytest

from trompe_server.system.memory import GIB


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
