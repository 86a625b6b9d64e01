"""Groups with ``list`` as the default command: ``trompe jobs --state failed``."""

from typing import Any, Final

import click

LIST: Final = "list"


class ListedByDefault(click.Group):
    """A group with ``list`` as its default command."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        names = {*self.commands, *self.get_help_option_names(ctx)}
        named = ctx.resilient_parsing or (args and args[0] in names)
        return super().parse_args(ctx, args if named else [LIST, *args])

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[Any]:
        """Complete commands, and the options of ``list``."""
        options = self.commands[LIST].shell_complete(ctx, incomplete) if incomplete.startswith("-") else []
        return super().shell_complete(ctx, incomplete) + [each for each in options if each.value != "--help"]

    def format_usage(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        formatter.write_usage(ctx.command_path, "[COMMAND] [ARGS]...  (without COMMAND: list)")
