"""The ``armcal`` command. Commands are imported when they are called, so that help is instant."""

import difflib
import errno
import itertools
import json
import os
import sys
import traceback
from importlib import import_module

import click
from click.exceptions import Exit
from click.shell_completion import CompletionItem

from armcal.cli.common import Output, output_fault, say
from armcal.errors import EXIT_DONE, EXIT_FAULT, EXIT_INTERRUPTED, ArmcalError, BrokenPluginError
from armcal.plugins import discover, missing_library, plugin_fault, use_plugins
from armcal.version import JSON_SCHEMA, __version__

COMMANDS = {
    "demo": ("armcal.cli.new:demo", "Copy a demonstration's files and calibrate its simulated arm."),
    "new": ("armcal.cli.new:new", "Begin a robot's files, or a plugin of your own."),
    "run": ("armcal.cli.run:run", "Calibrate: load, check, fit, validate, report."),
    "check": ("armcal.cli.identify:check", "Everything that can be known before solving."),
    "checks": ("armcal.cli.plugins:checks", "What each run asks of its data and its fit, and how surely."),
    "identify": ("armcal.cli.identify:identify", "Which parameters the poses determine; a minimal set of them."),
    "study": ("armcal.cli.run:study", "Compare model variants by cross-validated error, or trained at one load each."),
    "predict": ("armcal.cli.calibration:predict", "Where a calibrated arm goes for commanded joint angles."),
    "compensate": ("armcal.cli.calibration:compensate", "What to command so that the real arm arrives at targets."),
    "export": ("armcal.cli.calibration:export", "Write a calibrated arm in another program's format, such as URDF."),
    "calibration": ("armcal.cli.calibration:calibration", "Accept a calibration that was edited by hand."),
    "plan": ("armcal.cli.plan:plan", "Which poses to measure: the best few, and how good any could be."),
    "convert": ("armcal.cli.calibration:convert", "The geometry of an arm in another form: mdh, poe, urdf."),
    "simulate": ("armcal.cli.plan:simulate", "Simulate measurements of an arm with known parameters."),
    "plugins": ("armcal.cli.plugins:plugins", "List plugins, or check one."),
    "doctor": ("armcal.cli.doctor:doctor", "What is installed and what is missing; a simulated arm calibrated."),
}

_GLOBAL = ("--plugin", "--disable-plugin")


class LazyGroup(click.Group):
    """A group that knows its commands by name and imports one only to run it; plugins add theirs."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return [*COMMANDS, *_plugin_commands()]

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        target, _ = COMMANDS.get(cmd_name) or _plugin_commands().get(cmd_name, ("", ""))
        if not target:
            return None
        module, _, attribute = target.partition(":")
        try:
            command: click.Command = getattr(import_module(module), attribute)
        except ImportError as fault:
            raise missing_library(fault, f"armcal {cmd_name}") from fault
        return command

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Options of the whole program may also stand after the command, but not after ``--``."""
        first, rest, waiting = list[str](), list[str](), iter(args)
        for text in waiting:
            if text == "--":
                rest += [text, *waiting]
            elif text in _GLOBAL:
                first += [text, *itertools.islice(waiting, 1)]
            else:
                (first if text.startswith(tuple(f"{name}=" for name in _GLOBAL)) else rest).append(text)
        return super().parse_args(ctx, first + rest)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        if (command := self.get_command(ctx, args[0])) is not None:
            return args[0], command, args[1:]
        near = difflib.get_close_matches(args[0], self.list_commands(ctx), n=1, cutoff=0.6)
        if near and not args[0].startswith("-"):
            ctx.fail(f"No such command {args[0]!r}. Did you mean {near[0]!r}?")
        return super().resolve_command(ctx, args)

    def invoke(self, ctx: click.Context) -> object:
        """Armcal's own errors, and faults in a plugin's code, become one message and an exit code."""
        try:
            return super().invoke(ctx)
        except (click.ClickException, click.Abort, Exit):
            raise
        except (Exception, SystemExit) as fault:
            stated = fault if isinstance(fault, ArmcalError) else plugin_fault(fault)
            if stated is None and isinstance(fault, ImportError):  # of a library that is imported where it is needed
                stated = missing_library(fault, f"armcal {ctx.invoked_subcommand}")
            if stated is None:
                raise
            notes = getattr(stated, "__notes__", [])
            if isinstance(stated, BrokenPluginError) and stated.__cause__ is not None:
                say("".join(traceback.format_exception(stated.__cause__)).rstrip(), err=True)
            if "--json" in sys.argv:
                error = {"message": str(stated), "exit_code": stated.exit_code, "warnings": notes}
                click.echo(json.dumps({**JSON_SCHEMA, "error": error}, indent=2))
            for text in notes:
                say(f"warning: {text}", err=True)
            say(f"armcal: {stated}", err=True)
            ctx.exit(stated.exit_code)

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        commands = {**COMMANDS, **_plugin_commands()}
        named = [CompletionItem(name, help=text) for name, (_, text) in commands.items() if name.startswith(incomplete)]
        return [*named, *click.Command.shell_complete(self, ctx, incomplete)]

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        for title, commands in (("Commands", COMMANDS), ("Commands of plugins", _plugin_commands())):
            if commands:
                with formatter.section(title):
                    formatter.write_dl([(name, summary) for name, (_, summary) in commands.items()])


def _plugin_commands() -> dict[str, tuple[str, str]]:
    """By name: where a plugin's command is, and what it does."""
    registry = discover()
    names = dict.fromkeys(c.name for c in registry.components if c.kind == "command" and c.name not in COMMANDS)
    components = [registry.find("command", name) for name in names]
    return {command.name: (command.target, command.summary) for command in components}


@click.command(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="armcal")
@click.option("--plugin", "plugins", multiple=True, metavar="FILE", help="Load a plugin, or a folder of them.")
@click.option("--disable-plugin", "disabled", multiple=True, metavar="NAME", help="Leave a plugin out.")
def cli(plugins: tuple[str, ...], disabled: tuple[str, ...]) -> None:
    """Find what a robot arm really is: its geometry, its joints, its compliance, and how sure that is."""
    if plugins or disabled:
        use_plugins(*plugins, disabled=disabled)


def main() -> None:
    # One BLAS thread: sums come out the same to the last bit whatever the number of processors.
    for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(variable, "1")
    for name in ("stdout", "stderr"):
        if (stream := getattr(sys, name)) is not None:  # None: closed by who called
            setattr(sys, name, Output.instead_of(stream))
    code = _exit_code()
    if sys.stdout is not None:
        sys.stdout.flush()
        fault = output_fault()
        if fault is not None and fault.errno not in (errno.EPIPE, errno.EIO):  # else a reader that went away
            say(f"armcal: standard output cannot be written ({fault.strerror}).", err=True)
            code = code or EXIT_FAULT
    sys.exit(code)


def _exit_code() -> int:
    """Run the command that was called; how it ended. Ctrl-C ends as programs end by it, with 128 and SIGINT."""
    try:
        done = cli.main(prog_name="armcal", standalone_mode=False)
    except click.ClickException as fault:
        fault.show()
        return fault.exit_code
    except click.Abort as fault:
        if isinstance(fault.__cause__, EOFError):
            say("armcal: the input ended before the last question.", err=True)
            return EXIT_FAULT
        say("armcal: stopped by Ctrl-C.", err=True)
        return EXIT_INTERRUPTED
    except SystemExit as end:
        done = end.code
    return done if isinstance(done, int) else EXIT_DONE
