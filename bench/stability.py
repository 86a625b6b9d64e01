"""The stability suite: jobs against targets and classifiers that are not what they are taken for.

python -m bench.stability --out docs/experiments/stability_targets [--objects mug chair] [--seeds 0 1] [--only grain]

Shipped objects and classifier; resumable: what is in OUT/results.csv is not run again. A report of it:
`trompe experiment report OUT`.
"""

import argparse
import sys
import time
from pathlib import Path

from trompe_client.experiments.about import note_how_it_was_made
from trompe_server.experiments.stability import run_suite
from trompe_server.experiments.stability_chart import stability_markdown
from trompe_shared.experiment_table import ResultRow


def main() -> None:
    """Run what is missing and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    parser.add_argument("--objects", nargs="+", default=["mug", "chair"], metavar="NAME", help="shipped objects")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1], metavar="N")
    parser.add_argument("--epsilon", type=float, default=0.05)
    parser.add_argument("--only", default="", metavar="WORDS", help="cases whose name contains this")
    options, started = parser.parse_args(), time.monotonic()
    rows = run_suite(
        options.out,
        objects=options.objects,
        seeds=options.seeds,
        options={"epsilon": options.epsilon},
        only=options.only,
        on_row=tell,
    )
    command = " ".join(["python -m bench.stability", *sys.argv[1:]])
    note_how_it_was_made(options.out, command, seconds=time.monotonic() - started)
    print("\n" + stability_markdown(rows))


def tell(row: ResultRow, done: int, total: int) -> None:
    """A line for a new row."""
    drops = ", ".join(
        f"{name} {'n.a.' if drop is None else f'{drop:.2f}'}"
        for name, drop in (("A_drop", row.target_a_drop), ("held-out", row.held_out_a_drop))
    )
    name = f"{row.object}  {row.configuration}  seed {row.seed}"
    print(f"{done}/{total}  {name}: {drops}  {row.warnings or row.error}", flush=True)


if __name__ == "__main__":
    main()
