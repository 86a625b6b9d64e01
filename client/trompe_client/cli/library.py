"""Lists of stored things and of processes: ``trompe objects``, ``classifiers``, ``backgrounds``, ``workers``..."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from trompe_client import _core
from trompe_client._client import Client
from trompe_client._report import records_table
from trompe_client.cli.connection import with_client
from trompe_client.cli.options import ListedByDefault
from trompe_client.cli.output import say
from trompe_shared.api import BackgroundInfo, ClassifierInfo, ObjectInfo, RendererInfo, WorkerInfo

_file = click.argument("file", type=click.Path(exists=True))
_name = click.option("--name", help="Name to store it under; default: the file's name.")


def _list_command(kind: type[Any], name: str, help: str) -> click.Command:
    """A command that lists the records of a kind."""

    @click.command(name, help=help)
    @with_client
    def command(client: Client) -> None:
        found = client.send(_core.listed(kind))
        say(found, lambda: records_table(kind, found))

    return command


def _group(kind: type[Any], plural: str) -> Callable[[click.Command], click.Group]:
    """Make a group of a command that adds records, and of one that lists them."""

    def grouped(add: click.Command) -> click.Group:
        commands = [_list_command(kind, "list", f"List stored {plural}."), add]
        return ListedByDefault(plural, commands=commands, help=f"Stored {plural}: list or add.")

    return grouped


workers = _list_command(WorkerInfo, "workers", "List the attack workers.")
renderers = _list_command(RendererInfo, "renderers", "List the renderer workers.")


@_group(ObjectInfo, "objects")
@click.command("add")
@_file
@_name
@with_client
def objects(client: Client, file: str, name: str | None) -> None:
    """Store an object: a zip, a model file (.obj, .glb, .gltf, .fbx, .ply, .stl), or a folder with one."""
    stored = client.upload_object(file, name=name)
    say(stored, lambda: f"Object {stored.name}: {stored.id}")


@_group(ClassifierInfo, "classifiers")
@click.command("add")
@_file
@_name
@with_client
def classifiers(client: Client, file: str, name: str | None) -> None:
    """Store a classifier: a .pt2 or .onnx file, with its class names in a JSON file beside it."""
    stored = client.upload_classifier(file, name=name)
    say(stored, lambda: f"Classifier {stored.name}: {stored.id}")


@_group(BackgroundInfo, "backgrounds")
@click.command("add")
@_file
@with_client
def backgrounds(client: Client, file: str) -> None:
    """Store a background picture."""
    stored = client.upload_background(file)
    say({"id": stored, "name": Path(file).name}, lambda: f"Background {Path(file).name}: {stored}")
