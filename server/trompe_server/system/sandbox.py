"""Run the parser of an upload in a separate process with limits on memory and time.

``python -m trompe_server.system.sandbox MEMORY SECONDS MODULE ARGUMENT...`` is that process: it limits itself and runs
the module as ``__main__``. The last line the module prints is its answer, a JSON object; ``{"error": "..."}`` is a
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

MAX_FILE: Final = 2**29
"""Largest file the process may write, in bytes; its standard output counts as a file."""
MAX_ANSWER: Final = 2**22
OUT_OF_MEMORY: Final = 77
_SECRET: Final = "TROMPE_"
"""Prefix of environment variables hidden from the parser: tokens, database addresses."""
_ONE_THREAD: Final = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
"""Each thread of these libraries would claim address space of its own."""


def run_limited(
    module: str, arguments: Sequence[str], *, memory: int, seconds: float, failure: type[TrompeError]
) -> Mapping[str, Any]:
    """Return the answer of ``python -m module arguments`` within ``memory`` bytes of address space and ``seconds``.

    Raises ``failure`` with the refusal of the process, or with the cause of its end. Kills all of its children.
    """
    with tempfile.TemporaryFile() as out:
        process = start_limited(module, arguments, memory=memory, seconds=seconds, stdin=subprocess.DEVNULL, stdout=out)
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


def start_limited(
    module: str,
    arguments: Sequence[str] = (),
    *,
    memory: int,
    seconds: float,
    stdin: int = subprocess.PIPE,
    stdout: int | IO[bytes] = subprocess.PIPE,
) -> subprocess.Popen[bytes]:
    """Start ``python -m module arguments`` with ``memory`` bytes of address space and ``seconds`` of CPU time."""
    limits = [str(memory), str(math.ceil(seconds))]
    seen = {name: value for name, value in os.environ.items() if not name.startswith(_SECRET)}
    return subprocess.Popen(
        [sys.executable, "-m", "trompe_server.system.sandbox", *limits, module, *arguments],
        stdin=stdin,
        stdout=stdout,
        stderr=subprocess.DEVNULL,
        env=seen | _ONE_THREAD,
        start_new_session=True,
    )


def _answer(out: IO[bytes]) -> dict[str, Any]:
    """The JSON object on the last line, or an empty one."""
    out.seek(max(0, out.seek(0, os.SEEK_END) - MAX_ANSWER))
    lines = out.read().splitlines()
    try:
        answer = json.loads(lines[-1])
    except (IndexError, ValueError, RecursionError):
        return {}
    return answer if isinstance(answer, dict) else {}


def _too_long(seconds: float) -> str:
    return f"Reading it took more than {seconds:g} s and was stopped. Send a smaller or simpler file."


def _ended(code: int, memory: int, seconds: float) -> str:
    if code == -signal.SIGXCPU:
        return _too_long(seconds)
    if code == -signal.SIGKILL:
        return "The process reading it was killed, probably for want of memory. Send a smaller or simpler file."
    if code in {OUT_OF_MEMORY, -signal.SIGABRT}:
        return f"Reading it took more than {memory >> 20} MiB of memory. Send a smaller or simpler file."
    how = f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
    return f"The process reading it ended without an answer ({how}). Save it again with another program."


def _limit(memory: int, seconds: int) -> None:
    for what, limit, grace in (
        (resource.RLIMIT_AS, memory, 0),
        (resource.RLIMIT_CPU, seconds, 1),  # SIGXCPU comes before SIGKILL and tells the cause
        (resource.RLIMIT_FSIZE, MAX_FILE, 0),
        (resource.RLIMIT_CORE, 0, 0),
    ):
        hard = resource.getrlimit(what)[1]
        soft, last = (each if hard == resource.RLIM_INFINITY else min(each, hard) for each in (limit, limit + grace))
        resource.setrlimit(what, (soft, last))


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
