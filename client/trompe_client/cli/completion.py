"""``trompe completion``: shell completion of commands and options."""

import click
from click.shell_completion import get_completion_class


@click.command()
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
@click.pass_context
def completion(ctx: click.Context, shell: str) -> None:
    """Print the completion script of SHELL.

    \b
    bash:  trompe completion bash > ~/.local/share/bash-completion/completions/trompe
    zsh:   trompe completion zsh > "${fpath[1]}/_trompe"
    fish:  trompe completion fish > ~/.config/fish/completions/trompe.fish
    """
    kind = get_completion_class(shell)
    assert kind is not None
    click.echo(kind(ctx.find_root().command, {}, "trompe", "_TROMPE_COMPLETE").source())
