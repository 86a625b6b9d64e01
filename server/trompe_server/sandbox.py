"""Runs what parses an upload in a process of its own, which ends at limits of memory and time.

``python -m trompe_server.sandbox MEMORY SECONDS MODULE ARGUMENT...`` is that process: it limits itself, then runs the
module as ``__main__``. The module answers with one line of JSON, the last that it prints; ``{"error": "..."}`` is a
refusal.
"""

import json
import math
import os
import resource
import runpy
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import IO, Any, Final

from trompe_shared.errors import TrompeError

__all__ = ["run_limited"]

MAX_FILE: Final = 2**29
"""Bytes of any one file that the process may write, what it prints among them."""
MAX_ANSWER: Final = 2**22
OUT_OF_MEMORY: Final = 77
_SECRET: Final = "TROMPE_"
"""Begins the names of variables that are not for what reads an upload: tokens, database addresses."""
_ONE_THREAD: Final = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
"""Each thread of these libraries would take its share of the memory."""


def run_limited(
    module: str, arguments: Sequence[str], *, memory: int, seconds: float, failure: type[TrompeError]
) -> Mapping[str, Any]:
    """The answer of ``python -m module arguments``, run with ``memory`` bytes of address space and for ``seconds``.

    Raises ``failure`` with the process's own refusal, or with what ended it. Nothing that it started outlives the call.
    """
    limits = [str(memory), str(math.ceil(seconds))]
    command = [sys.executable, "-m", "trompe_server.sandbox", *limits, module, *arguments]
    with tempfile.TemporaryFile() as out:
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=subprocess.DEVNULL,
            env=_environment(),
            start_new_session=True,
        )
        try:
            code = process.wait(seconds)
        except subprocess.TimeoutExpired:
            raise failure(_too_long(seconds)) from None
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        answer = _answer(out)
    if "error" in answer:
        raise failure(str(answer["error"]))
    if code == 0 and answer:
        return answer
    raise failure(_ended(code, memory, seconds))


def _environment() -> dict[str, str]:
    return {name: value for name, value in os.environ.items() if not name.startswith(_SECRET)} | _ONE_THREAD


def _answer(out: IO[bytes]) -> dict[str, Any]:
    """The JSON object on the last line; an empty one where there is none."""
    out.seek(max(0, out.seek(0, os.SEEK_END) - MAX_ANSWER))
    lines = out.read().splitlines()
    try:
        answer = json.loads(lines[-1])
    except (IndexError, ValueError, RecursionError):
        return {}
    return answer if isinstance(answer, dict) else {}


def _too_long(seconds: float) -> str:
    return f"Reading it took more than {seconds:g} s and was given up. Send something smaller or simpler."


def _ended(code: int, memory: int, seconds: float) -> str:
    if code in {-signal.SIGXCPU, -signal.SIGKILL}:
        return _too_long(seconds)
    if code in {OUT_OF_MEMORY, -signal.SIGABRT}:
        return f"Reading it took more than {memory >> 20} MiB of memory. Send something smaller or simpler."
    how = f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
    return f"The process that read it ended without an answer ({how}). Save it again with another program."


def _limit(memory: int, seconds: int) -> None:
    for what, limit in (
        (resource.RLIMIT_AS, memory),
        (resource.RLIMIT_CPU, seconds),
        (resource.RLIMIT_FSIZE, MAX_FILE),
        (resource.RLIMIT_CORE, 0),
    ):
        hard = resource.getrlimit(what)[1]
        allowed = limit if hard == resource.RLIM_INFINITY else min(limit, hard)
        resource.setrlimit(what, (allowed, allowed))


def _main(arguments: Sequence[str]) -> None:
    memory, seconds, module, *rest = arguments
    _limit(int(memory), int(seconds))
    sys.argv = [module, *rest]
    try:
        runpy.run_module(module, run_name="__main__", alter_sys=True)
    except MemoryError:
        sys.exit(OUT_OF_MEMORY)


if __name__ == "__main__":
    _main(sys.argv[1:])
