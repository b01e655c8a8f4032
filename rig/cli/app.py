"""The command line: a group that finds each command's module when it is asked for.

A command is one module of this package with a click command named ``command``, or of another package that names its
command by an entry point of the group ``dea_rig.commands``. Such modules import only click at their top, and heavy
things inside the functions that use them, so that ``dea-rig --help`` answers at once.
"""

from __future__ import annotations

import os
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

ENTRY_POINTS = "dea_rig.commands"
HELPERS = {  # modules of this package that are no commands
    "app",
    "files",
    "fit_options",
    "import_options",
    "running",
    "sheet_over_time",
    "show",
    "swapped",
    "talk",
    "topics",
}
EXIT_CODES = """Exit codes: 0 done; 1 failed; 2 a file or option cannot be used, nothing was touched; 3 a limit, or a
plan that cannot be carried out; 4 a fault of the rig; 130 stopped by the operator."""


class Commands(click.Group):
    """The commands of this package and of others; an error for the operator is a message and an exit code."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return sorted({*_own(), *_others()})

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        own = _own()
        if cmd_name in own:
            command: click.Command = import_module(f"rig.cli.{own[cmd_name]}").command
            return command
        entry = _others().get(cmd_name)
        return None if entry is None else _load(entry)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """As click does it; a mistyped name is answered with the nearest one."""
        if args and not args[0].startswith("-") and args[0] not in (names := self.list_commands(ctx)):
            from difflib import get_close_matches

            near = get_close_matches(args[0], names, n=1, cutoff=0.6)
            ctx.fail(f"There is no command '{args[0]}'." + (f" Did you mean '{near[0]}'?" if near else ""))
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """One line for each command. Ours stands at the top of its file, so that no command is imported for it."""
        own, others = _own(), _others()
        lines = {name: _load(entry).get_short_help_str(200) for name, entry in others.items()}
        lines |= {name: _first_line(module) for name, module in own.items()}
        with formatter.section("Commands"):
            formatter.write_dl(sorted(lines.items()))

    def invoke(self, ctx: click.Context) -> Any:
        try:
            return super().invoke(ctx)
        except (click.ClickException, click.exceptions.Exit):
            raise
        except click.Abort:
            click.echo("\nNot answered; nothing was changed.", err=True)
            ctx.exit(2)
        except KeyboardInterrupt:  # a run takes Ctrl-C itself; this is before it, after it, or another command
            click.echo("\nStopped by Ctrl-C. Nothing was being driven.", err=True)
            ctx.exit(130)
        except BrokenPipeError:
            ctx.exit(1)
        except Exception as error:
            code = _exit_code(error)
            if code is None:
                raise
            from rig.base.terminal import tell

            tell(_plain(error), colour="red")
            for note in getattr(error, "__notes__", []):
                tell(_plain(note))
            ctx.exit(code)


def _plain(text: object) -> str:
    """What is told, without anything that could drive the terminal: it may quote a file or a device."""
    from rig.base.text import printable

    return printable(str(text), keep="\n")


def _own() -> dict[str, str]:
    """Command name -> module of this package."""
    modules = {file.stem for file in Path(__file__).parent.glob("[a-z]*.py")}
    return {name.rstrip("_").replace("_", "-"): name for name in modules - HELPERS}


def _first_line(module: str) -> str:
    """What a command does, of the first line of its file: three quotes, its name in back quotes, a colon, this."""
    with (Path(__file__).parent / f"{module}.py").open(encoding="utf-8") as file:
        said = file.readline().rstrip().removesuffix('"""').partition("``: ")[2]
    return said[:1].upper() + said[1:]


def _others() -> dict[str, EntryPoint]:
    """Command name -> entry point of another package."""
    from importlib.metadata import entry_points

    return {entry.name: entry for entry in entry_points(group=ENTRY_POINTS)}


def _load(entry: EntryPoint) -> click.Command:
    """Another package's command; when it cannot be loaded, one that says so, and the rest goes on working."""
    try:
        command = entry.load()
    except Exception as error:
        command = error
    if isinstance(command, click.Command):
        return command
    where = f"{entry.value}, an entry point of {ENTRY_POINTS}"
    why = f"it is not a click command: {command!r}" if not isinstance(command, Exception) else repr(command)
    message = f"The command {entry.name} ({where}) cannot be loaded: {why}."

    def refuse(**_: object) -> None:
        raise click.ClickException(message)

    return click.Command(entry.name, callback=refuse, help=message, short_help="Cannot be loaded.")


def _exit_code(error: Exception) -> int | None:
    """The exit code of an error that is meant for the operator; None for a mistake of ours."""
    from rig.base.errors import RigError

    if isinstance(error, RigError):
        return error.exit_code
    from drivers.links.link import DeviceError

    if isinstance(error, DeviceError):
        return 4
    return 1 if isinstance(error, OSError) else None  # the disk or terminal that was to be written to


@click.group(cls=Commands, context_settings={"help_option_names": ["-h", "--help"]}, epilog=EXIT_CODES)
@click.version_option(package_name="dea-rig")
def main() -> None:
    """Characterise conical dielectric elastomer actuators on a bench, real or simulated.

    Start with `dea-rig demo`. Software is not the safety function: interlock, emergency stop, current limit and
    bleed resistor are.
    """
    keep_streams()


def keep_streams() -> None:
    """Open what of standard input, output and error is closed, on nothing, for this program and those that it starts.

    Else the next file that is opened gets that number, a port for one, and what is said to the operator goes there.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)  # the lowest number that is free: this one
