"""Processes of attempts on one node of a cluster, forked by an actor for the tasks that hold the resources.

A new process that imports torch and the attack takes 5 s of a core. The fork server of the actor has imported them, so
neither a dead attempt nor a dead task has to wait for that.
"""

import pickle
import select
import threading
from contextlib import suppress
from multiprocessing.connection import Connection, Listener

from trompe_server.executor.process import Setup, ending, fork
from trompe_server.executor.task import DiedError, connect


class Forks:
    """Forks a process for each task of its node that connects to ``address``, and kills it once the task is gone."""

    def __init__(self) -> None:
        self._listener = Listener(family="AF_UNIX")  # in a folder for this user alone
        threading.Thread(target=self._accept, daemon=True).start()

    def address(self) -> str:
        """Where tasks connect."""
        return str(self._listener.address)

    def fault(self, setup: Setup, mark: str) -> str | None:
        """Why attempts cannot run on this node, which must reach the store and the database; ``None`` if they can.

        ``mark``: name of the dispatcher that asks, in both. On a sound node the fork server has started then.
        """
        from trompe_server.executor.attempts import fault_here

        fault = fault_here(setup.settings, mark)
        if fault is None:
            try:
                connect(self.address(), pickle.dumps(setup), {}).close()
            except DiedError as died:
                return f"its attack workers die before they are ready ({died})"
        return fault

    def _accept(self) -> None:
        while True:
            threading.Thread(target=self._look_after, args=(self._listener.accept(),), daemon=True).start()

    def _look_after(self, task: Connection) -> None:
        with task, suppress(EOFError, OSError):  # the task died, or the fork server, which closes ``task``
            environment, setup = task.recv(), task.recv()
            process = fork(task, environment, setup)
            either = select.poll()
            either.register(task, 0)  # hang-up alone
            either.register(process.sentinel, select.POLLIN)
            either.poll()
            process.kill()  # even a frozen one
            process.join()
            task.send(DiedError(ending(process.exitcode)))
