"""The commands that this package adds to ``trompe experiment``, and ``python -m trompe_server.experiments``."""

import sys
from pathlib import Path

import click

from trompe_shared.errors import TrompeError

__all__ = ["export_variants", "fill", "main", "objects_grid", "report"]

_folder = click.argument("folder", metavar="DIR", type=click.Path(exists=True, file_okay=False, path_type=Path))


@click.group()
def main() -> None:
    """Figures and reports of experiments."""


@main.command()
@_folder
@click.option("--parquet", is_flag=True, help="Write results.parquet as well (needs pyarrow).")
def report(folder: Path, parquet: bool) -> None:
    """Write the experiment in DIR as one HTML file, and its figures as SVG and PNG."""
    from trompe_server.experiments.parquet import write_parquet
    from trompe_server.experiments.report import write_report

    try:
        click.echo(f"written: {write_report(folder)}")
        if parquet:
            click.echo(f"written: {write_parquet(folder)}")
    except TrompeError as error:
        raise click.ClickException(str(error)) from error


@main.command()
@click.argument("document", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.option("--check", is_flag=True, help="Change nothing; fail when it is not in step with its data.")
def fill(document: Path, check: bool) -> None:
    """Fill the blocks of DOCUMENT with figures and tables from the data they name."""
    from trompe_server.experiments import documents

    try:
        changed = documents.out_of_step(document) if check else documents.fill(document)
    except TrompeError as error:
        raise click.ClickException(str(error)) from error
    for line in changed:
        click.echo(line)
    if check and changed:
        click.echo(f"Run: python -m trompe_server.experiments fill {document}", err=True)
        sys.exit(1)


@main.command("objects-grid")
@click.option("--out", required=True, type=click.Path(dir_okay=False, path_type=Path), help="The picture, a .png.")
@click.option("--assets", envvar="TROMPE_ASSETS", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--object", "names", multiple=True, help="An object; several times. Default: all.")
def objects_grid(out: Path, assets: Path | None, names: tuple[str, ...]) -> None:
    """Show the paper's objects (TROMPE_ASSETS), or the shipped ones, in target and surrogates."""
    from trompe_server.experiments.library_objects import paper_objects, shipped, shown
    from trompe_server.experiments.own_renderer import running_renderer
    from trompe_server.experiments.pictures import objects_grid as grid

    objects = shipped() if assets is None else paper_objects(assets)
    with running_renderer() as target:
        grid([shown(each) for each in objects if each.name in names or not names], target).save(out)
    click.echo(f"written: {out}")


@main.command("export-variants")
@click.option("--out", required=True, type=click.Path(file_okay=False, path_type=Path), help="Folder to write to.")
@click.option("--object", "objects", multiple=True, help="A shipped object; several times. Default: all.")
@click.option("--variants", default=2, show_default=True, type=click.IntRange(1), help="Variants of each object.")
@click.option("--epsilon", default=0.05, show_default=True, type=click.FloatRange(0, 1, min_open=True))
@click.option("--views", default=40, show_default=True, type=click.IntRange(1), help="Pictures of each variant.")
@click.option("--seed", default=0, show_default=True, type=click.IntRange(0))
def export_variants(out: Path, objects: tuple[str, ...], variants: int, epsilon: float, views: int, seed: int) -> None:
    """Write adversarial variants of the shipped objects: zips, and labelled pictures in train and test folders."""
    from trompe_server.experiments import variants as exporting

    try:
        made = exporting.export_variants(
            out, names=objects, per_object=variants, epsilon=epsilon, views=views, seed=seed, on_variant=click.echo
        )
    except TrompeError as error:
        raise click.ClickException(str(error)) from error
    click.echo(f"written: {len(made)} variants and labels.csv in {out}")
