"""A Ray cluster of simulated nodes in a process of its own, for Ray keeps its configuration as long as a process lives.

``python -m tests.service.ray_nodes PORT``: each line of standard input is a command, each line of standard output the
answer to it. The cluster ends with the input.
"""

import contextlib
import json
import os
import subprocess
import sys
from typing import IO, Any, Final, Self

from tests.served import FAKE, command_line, free_port, process_table

TOKEN: Final = "t" * 32
ACCESS: Final = {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": TOKEN, "RAY_USAGE_STATS_ENABLED": "0"}
"""Environment in which a process reaches the cluster."""
STORE_BYTES: Final = 80 * 2**20


class RayNodes:
    """A cluster with a client server at ``address``; a context manager. ``nodes``: ids of the nodes that run jobs.

    Each has one core; the last one has a simulated GPU too. ``environment`` is added to that of the attempts.
    """

    def __init__(self, nodes: int = 3, **environment: str) -> None:
        port = free_port()
        self.address = f"ray://127.0.0.1:{port}"
        self.process = subprocess.Popen(
            [sys.executable, "-m", "tests.service.ray_nodes", str(port)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=os.environ | FAKE | ACCESS | environment,
        )
        self.nodes = [self._ask(num_gpus=int(number == nodes - 1)) for number in range(nodes)]

    def add(self, **resources: int) -> str:
        """Start a node; its id."""
        self.nodes.append(self._ask(**resources))
        return self.nodes[-1]

    def kill(self, node: str) -> None:
        self.nodes.remove(node)
        self._ask(kill=node)

    def _ask(self, **command: Any) -> str:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        print(json.dumps(command), file=self.process.stdin, flush=True)
        answer = self.process.stdout.readline()
        assert answer, "the process of the Ray cluster died; its messages are in the captured output"
        return answer.strip()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.process.communicate(timeout=60)


def task_of(job: str) -> int:
    """The process of the task that holds an attempt of the job, by the name that Ray gives it."""
    found = [pid for pid in process_table() if "".join(command_line(pid)).startswith(f"ray::{job}/")]
    assert found, f"no process runs {job}"
    return found[0]


def serve(port: int, answers: IO[str]) -> None:
    """Start a head, then nodes on demand."""
    from ray.cluster_utils import Cluster

    head = {"num_cpus": 0, "include_dashboard": False, "ray_client_server_port": port}
    cluster = Cluster(initialize_head=True, head_node_args=head | {"object_store_memory": STORE_BYTES})
    nodes: dict[str, Any] = {}
    for line in sys.stdin:
        command = json.loads(line)
        if "kill" in command:
            node = nodes.pop(command["kill"])
            cluster.remove_node(node, allow_graceful=False)
        else:
            node = cluster.add_node(num_cpus=1, object_store_memory=STORE_BYTES, **command)
            nodes[node.node_id] = node
        print(node.node_id, file=answers, flush=True)
    cluster.shutdown()


if __name__ == "__main__":
    with os.fdopen(os.dup(1), "w") as answers, contextlib.redirect_stdout(sys.stderr):
        os.dup2(2, 1)  # Ray prints
        serve(int(sys.argv[1]), answers)
