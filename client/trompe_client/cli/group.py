"""The command ``trompe``. Its subcommands are imported when they are called."""

from importlib import import_module, metadata
from typing import Any, Final

import click

from trompe_client import _errors as errors
from trompe_client.cli.output import show_error
from trompe_shared.errors import ClassifierError, LabelError, ObjectError, SpecError, TrompeError

COMMANDS_GROUP: Final = "trompe.commands"

OWN: Final = {
    "attack": "trompe_client.cli.attack",
    "backgrounds": "trompe_client.cli.library",
    "cancel": "trompe_client.cli.jobs",
    "classifiers": "trompe_client.cli.library",
    "completion": "trompe_client.cli.completion",
    "jobs": "trompe_client.cli.jobs",
    "judge": "trompe_client.cli.judge",
    "objects": "trompe_client.cli.library",
    "renderers": "trompe_client.cli.library",
    "report": "trompe_client.cli.jobs",
    "watch": "trompe_client.cli.jobs",
    "workers": "trompe_client.cli.library",
}
"""Commands of this package, and their modules."""

EXTENSIONS: Final = {
    "serve": "Run the service: API, attack worker and renderer.",
    "worker": "Run the jobs of a database, without the API.",
    "demo": "Attack a shipped object and show the result.",
    "doctor": "Check this machine and suggest repairs.",
    "experiment": "Run grids of jobs and report their results.",
    "migrate": "Create or upgrade the service's database.",
    "render": "Run a renderer worker (SAILenv's protocol).",
    "token": "Create, list and revoke access tokens.",
}
"""Commands of our other packages, with their lines in ``trompe --help``."""

EXTRAS: Final = dict.fromkeys(EXTENSIONS, "server") | {
    "experiment": "experiments",
    "render": "renderer",
    "judge": "server",
}
"""Extra that installs each of them, and of an own command without a server."""

INTERRUPTED: Final = 130

EXITS: Final = {
    0: "success; n.a. is a success too",
    1: "any other error; `doctor` or `judge --verify` found a fault",
    2: "invalid options or files",
    3: "no server answers",
    4: "refused: missing or wrong token, or missing right; or too many requests",
    5: "no such job, object, classifier or file, or not possible in its state",
    6: "the job failed",
    7: "the job was cancelled",
    8: "--timeout is over; the job continues",
    INTERRUPTED: "interrupted by Ctrl-C; a job on a server continues",
}
"""Exit codes, listed by ``trompe --help`` and docs/cli.md."""

_CODES: Final[dict[int, tuple[type[Exception], ...]]] = {
    2: (SpecError, ObjectError, ClassifierError, LabelError, errors.BadRequest),
    3: (errors.ServerUnreachable, errors.EmbeddedServerError),
    4: (errors.Unauthorized, errors.Forbidden, errors.TooMany),
    5: (errors.NotFound, errors.Conflict),
    6: (errors.JobFailed,),
    7: (errors.JobCancelled,),
    8: (errors.WaitTimeout,),
}


class _Trompe(click.Group):
    """A group with commands by name or entry point; reports errors as messages and exit codes."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return sorted({*OWN, *EXTENSIONS, *metadata.entry_points(group=COMMANDS_GROUP).names})

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name in OWN:
            command = getattr(import_module(OWN[cmd_name]), cmd_name)
            assert isinstance(command, click.Command)
            return command
        return _load_extension(cmd_name) if cmd_name in self.list_commands(ctx) else None

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[Any]:
        """Complete names without importing commands."""
        from click.shell_completion import CompletionItem

        names = [name for name in self.list_commands(ctx) if name.startswith(incomplete)]
        return [CompletionItem(name) for name in names] + click.Command.shell_complete(self, ctx, incomplete)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List the commands without importing those of other packages."""
        lines = dict(EXTENSIONS)
        for name in OWN:
            command = self.get_command(ctx, name)
            lines[name] = command.get_short_help_str(100) if command else ""
        with formatter.section("Commands"):
            formatter.write_dl([(name, lines.get(name, "")) for name in self.list_commands(ctx)])

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Exit codes"):
            formatter.write_dl([(str(code), meaning) for code, meaning in EXITS.items()])

    def invoke(self, ctx: click.Context) -> Any:
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            click.echo("Interrupted.", err=True)
            ctx.exit(INTERRUPTED)
        except BrokenPipeError:
            raise
        except ModuleNotFoundError as error:  # raised when the command runs
            if ctx.invoked_subcommand not in EXTRAS:
                raise
            raise _missing_extra(ctx.invoked_subcommand, error) from error
        except (TrompeError, OSError) as error:
            show_error(error, code=_exit_code(error), flags=ctx.invoked_subcommand in OWN)
            ctx.exit(_exit_code(error))


def _exit_code(error: Exception) -> int:
    """Exit code of an error."""
    return next((code for code, kinds in _CODES.items() if isinstance(error, kinds)), 1)


def _load_extension(name: str) -> click.Command:
    """Import a command of another package. Raises ``ClickException`` for a missing extra."""
    found = list(metadata.entry_points(group=COMMANDS_GROUP, name=name))
    try:
        if not found:
            raise ModuleNotFoundError(f"no installed package provides the command {name!r}")
        command = found[0].load()
    except ModuleNotFoundError as error:
        raise _missing_extra(name, error) from error
    assert isinstance(command, click.Command)
    return command


def _missing_extra(name: str, error: ModuleNotFoundError) -> click.ClickException:
    if name not in EXTRAS:
        return click.ClickException(f"`trompe {name}` cannot be loaded: {error}.")
    extra = EXTRAS[name]
    return click.ClickException(f"`trompe {name}` needs the {extra} extra: pip install 'trompe[{extra}]' ({error})")


@click.group(cls=_Trompe, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 120})
@click.version_option(package_name="trompe")
def main() -> None:
    """Craft adversarial 3D objects: repaint a texture so that people see the same object and a classifier does not."""
