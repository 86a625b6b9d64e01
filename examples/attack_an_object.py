"""Attack an object through a running server: start one by `trompe serve`, then run this file.

    python examples/attack_an_object.py [OBJECT LABEL]

OBJECT is a zip, a folder with an .obj, or the name of a stored object; without arguments it is the mug that comes with
Trompe. TROMPE_SERVER names a server elsewhere.
"""

import os
import sys

from trompe_client import Client, ClientError


def main() -> None:
    thing, label = sys.argv[1:3] or ("mug", "mug")
    with Client(os.environ.get("TROMPE_SERVER", "http://127.0.0.1:8000")) as client:
        job = client.attack(thing, label=label, epsilon=0.1).wait(progress=True)
        target = job.result().target
        print(f"{job.id}: recognised in {target.a_before:.0%} of the views before, in {target.a_after:.0%} after")
        print(*job.download("out"), sep="\n")


if __name__ == "__main__":
    try:
        main()
    except ClientError as error:
        sys.exit(str(error))
