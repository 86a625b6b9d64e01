"""Classify single images, while somebody looks at them, in a process of its own: this one stays free of torch."""

import json
import subprocess
import threading
import weakref
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import IO, Any, Final, cast

from trompe_server.errors import ServiceError
from trompe_server.system.sandbox import start_limited
from trompe_shared.errors import ClassifierError

MODULE: Final = "trompe_server.library.classify"
MEMORY: Final = 8 * 2**30
"""Bytes of address space; networks for ImageNet take less than half."""
CPU_SECONDS: Final = 3600.0
"""CPU time after which the process is replaced."""
ANSWER_SECONDS: Final = 60.0
"""Longest wait for an answer; a first one includes the start of the process and loading the network."""
MOST_WAITING: Final = 8

Classified = tuple[int, float, float]
"""Class, its probability, and the probability of all of the object's classes."""


class Networks:
    """Networks that classify images, one request at a time. Thread-safe. The process starts with the first request."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._turn = threading.Lock()
        self._waiting = threading.BoundedSemaphore(MOST_WAITING)

    def classify(
        self, network: str, images: Sequence[bytes], *, labels: Sequence[int], strengths: Mapping[str, float]
    ) -> list[Classified]:
        """Classify image files of one size.

        network: argument of ``load_classifier``. labels: the object's classes. strengths: of the image pipeline's
        operations, by their names.

        Raises ``ClassifierError`` with the refusal of the process, and ``ServiceError`` if too many requests wait.
        """
        asked = {"network": network, "labels": list(labels), "strengths": dict(strengths), "sizes": [*map(len, images)]}
        if not self._waiting.acquire(blocking=False):
            raise ServiceError("Too many images wait for classification; send fewer at the same time.")
        try:
            with self._turn:
                answer = _ask(self._running(), json.dumps(asked).encode() + b"\n" + b"".join(images))
        finally:
            self._waiting.release()
        if "error" in answer:
            raise ClassifierError(str(answer["error"]))
        return [tuple(row) for row in answer["found"]]

    def _running(self) -> subprocess.Popen[bytes]:
        if self._process is None or self._process.poll() is not None:
            self._process = start_limited(MODULE, memory=MEMORY, seconds=CPU_SECONDS)
            weakref.finalize(self, _end, self._process)
        return self._process


def _ask(process: subprocess.Popen[bytes], request: bytes) -> dict[str, Any]:
    """The answer of the process, which is killed if it takes too long. Raises ``ClassifierError`` without an answer."""
    late = threading.Timer(ANSWER_SECONDS, process.kill)
    late.start()
    try:
        requests, answers = cast(IO[bytes], process.stdin), cast(IO[bytes], process.stdout)
        requests.write(request)
        requests.flush()
        line = answers.readline()
        answer: dict[str, Any] = json.loads(line)
    except (BrokenPipeError, ValueError) as error:
        _end(process)
        raise ClassifierError(
            f"The network's process ended without an answer within {ANSWER_SECONDS:g} s; try again, or choose another "
            "network."
        ) from error
    finally:
        late.cancel()
    return answer


def _end(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    with suppress(BrokenPipeError), process:  # closes the pipes and waits
        pass
