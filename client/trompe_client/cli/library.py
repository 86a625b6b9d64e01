"""Commands about what is stored: ``trompe objects``, ``trompe classifiers``, ``trompe backgrounds``."""

from pathlib import Path

import click

from trompe_client._client import Client
from trompe_client._report import backgrounds_table, classifiers_table, objects_table
from trompe_client.cli.connection import with_client
from trompe_client.cli.grouping import ListedByDefault
from trompe_client.cli.output import json_option, say

__all__ = ["backgrounds", "classifiers", "objects"]

_file = click.argument("file", type=click.Path(exists=True))
_name = click.option("--name", help="What it shall be called. Default: as the file.")


@click.group(cls=ListedByDefault)
def objects() -> None:
    """Stored objects: list them, add one."""


@objects.command("list")
@json_option
@with_client
def list_objects(client: Client) -> None:
    """List stored objects."""
    found = client.objects()
    say(found, lambda: objects_table(found))


@objects.command("add")
@_file
@_name
@json_option
@with_client
def add_object(client: Client, file: str, name: str | None) -> None:
    """Store an object: a zip, a model file (.obj, .glb, .gltf, .fbx, .ply, .stl), or a folder with one."""
    stored = client.upload_object(file, name=name)
    say(stored, lambda: f"Object {stored.name}: {stored.id}")


@click.group(cls=ListedByDefault)
def classifiers() -> None:
    """Stored classifiers: list them, add one."""


@classifiers.command("list")
@json_option
@with_client
def list_classifiers(client: Client) -> None:
    """List stored classifiers."""
    found = client.classifiers()
    say(found, lambda: classifiers_table(found))


@classifiers.command("add")
@_file
@_name
@json_option
@with_client
def add_classifier(client: Client, file: str, name: str | None) -> None:
    """Store a classifier: a .pt2, TorchScript (.pt) or .onnx file, with its class names in a JSON file beside it."""
    stored = client.upload_classifier(file, name=name)
    say(stored, lambda: f"Classifier {stored.name}: {stored.id}")


@click.group(cls=ListedByDefault)
def backgrounds() -> None:
    """Uploaded backgrounds: list them, add one."""


@backgrounds.command("list")
@json_option
@with_client
def list_backgrounds(client: Client) -> None:
    """List uploaded backgrounds."""
    found = client.backgrounds()
    say(found, lambda: backgrounds_table(found))


@backgrounds.command("add")
@_file
@json_option
@with_client
def add_background(client: Client, file: str) -> None:
    """Store a picture."""
    stored = client.upload_background(file)
    say({"id": stored, "name": Path(file).name}, lambda: f"Background {Path(file).name}: {stored}")
