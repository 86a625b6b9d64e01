"""The server: accepts agents, each in a thread of its own. One more thread renders for all of them, in turn."""

import contextlib
import itertools
import logging
import math
import socket
import threading
import time
from select import select
from typing import Final

from trompe_renderer.engines.render_thread import RenderThread
from trompe_renderer.protocol.agent import MAX_REASON, Agent, Shared
from trompe_renderer.protocol.limits import Limits, Options
from trompe_renderer.protocol.link import Link
from trompe_shared.errors import ProtocolError

RETRY_PAUSE: Final = 0.5
"""Seconds until the next try when no agent could be accepted."""

log = logging.getLogger(__name__)


class Server:
    """A renderer worker on a listening socket, which it closes at its end."""

    def __init__(
        self, listener: socket.socket, renderer: RenderThread, options: Options, limits: Limits | None = None
    ) -> None:
        self._listener, self._limits = listener, limits or Limits()
        self._shared = Shared(renderer, options, self._limits)
        self._agents: dict[int, tuple[Link, threading.Thread]] = {}
        self._left = threading.Condition()
        self._waker, self._wake = socket.socketpair()
        self._waker.setblocking(False)
        self.address: tuple[str, int] = listener.getsockname()[:2]

    def serve_forever(self) -> None:
        """Accept agents until ``stop``, then finish the answers that are due."""
        for number in itertools.count():
            if self._wake in select([self._listener, self._wake], [], [])[0]:
                break
            try:
                self._accept(number)
            except (OSError, RuntimeError) as error:  # no file descriptor or thread left, or the agent is gone already
                log.warning("agent %d: cannot be accepted: %s", number, error)
                time.sleep(RETRY_PAUSE)
        self._finish()

    def stop(self) -> None:
        """Make ``serve_forever`` return. Takes no lock: a signal handler may call it any number of times."""
        with contextlib.suppress(OSError):  # full or closed already
            self._waker.send(b"!")

    def _accept(self, number: int) -> None:
        connection, peer = self._listener.accept()
        if not self._make_room():
            log.warning("agent %d from %s: refused, %d agents are connected", number, peer[0], self._limits.agents)
            connection.close()
            return
        link = Link(connection, self._shared.requests, self._limits)
        thread = threading.Thread(target=self._serve, args=(link, number), daemon=True, name=f"agent-{number}")
        self._agents[number] = link, thread
        try:
            thread.start()
        except RuntimeError:
            del self._agents[number]
            link.close()
            raise

    def _finish(self) -> None:
        self._shared.stopping.set()
        for each in (self._listener, self._wake, self._waker):
            each.close()
        agents = [*self._agents.values()]
        for link, _ in agents:
            link.hang_up()
        deadline = time.monotonic() + self._limits.stop_timeout
        for _, thread in agents:
            thread.join(max(0.0, deadline - time.monotonic()))

    def _make_room(self) -> bool:
        """Whether there is a place for one more agent. The agent idle for longest may lose its place."""
        with self._left:
            if len(self._agents) < self._limits.agents:
                return True
            idle = [(since, link) for link, _ in self._agents.values() if (since := link.idle_since) is not None]
            since, link = min(idle, key=lambda item: item[0], default=(math.inf, None))
            if link is None or time.monotonic() - since < self._limits.idle_timeout:
                return False
            link.hang_up()
            return self._left.wait_for(lambda: len(self._agents) < self._limits.agents, timeout=1.0)

    def _serve(self, link: Link, number: int) -> None:
        try:
            self._converse(Agent(link, number, self._shared), number)
        except Exception:
            log.exception("agent %d: cannot be served", number)
        finally:
            link.close()
            with self._left:
                del self._agents[number]
                self._left.notify_all()

    @staticmethod
    def _converse(agent: Agent, number: int) -> None:
        try:
            agent.serve()
        except ProtocolError as error:
            log.warning("agent %d: closed at %s, malformed request: %s", number, agent.doing, str(error)[:MAX_REASON])
        except TimeoutError as error:
            log.warning("agent %d: closed at %s: %s", number, agent.doing, error)
        except (EOFError, OSError) as error:
            log.info("agent %d: gone (%s)", number, error)
        except Exception:
            log.exception("agent %d: closed at %s after an internal error", number, agent.doing)
