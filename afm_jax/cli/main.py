"""`afm-jax`: the table of commands; each command's module is imported when it is called."""

import difflib
import sys
from collections.abc import Sequence
from importlib import import_module
from typing import Any

import click

from afm_jax.cli.failures import exit_code_of

COMMANDS = {
    "accuracy": ("afm_jax.cli.accuracy", "Show error against time, and the cheapest setting for a wanted accuracy."),
    "bench": ("afm_jax.cli.bench", "Measure impacts per second, next to SciPy."),
    "calibrate": ("afm_jax.cli.calibrate", "Fit frequency and quality factor to a free resonance sweep."),
    "collide": ("afm_jax.cli.collide", "Let free tips collide with the sample: rebound, delay, capture, energy."),
    "design": ("afm_jax.cli.design", "Choose the drives to measure next, and forecast what they will determine."),
    "doctor": ("afm_jax.cli.doctor", "Say what is installed, how JAX computes, and whether its cache works."),
    "effects": ("afm_jax.cli.effects", "Say what each effect of a scene changes and costs, and which can be left out."),
    "figures": ("afm_jax.cli.figures", "Draw figures 2 to 11 of the paper, with its statements checked."),
    "fit": ("afm_jax.cli.fit", "Fit the impact law to a table of vibration amplitudes."),
    "fit-law": ("afm_jax.cli.fit_law", "Fit the impact law and the delay law to a simulated contact."),
    "invert": ("afm_jax.cli.invert", "Read speeds and delay of every impact off amplitude and phase, without a law."),
    "lockin": ("afm_jax.cli.lockin", "Read response order, amplitudes and phase off time traces of the deflection."),
    "orbits": ("afm_jax.cli.orbits", "Find all single-impact orbits of a scene, and whether they are stable."),
    "simulate": ("afm_jax.cli.simulate", "Follow a scene in time: contacts, amplitudes, phases, energies."),
    "verify": ("afm_jax.cli.verify", "Compare eqs. 5 to 8 with automatic differentiation and with 50 digits."),
}
"""For every command the module whose `command` it is, and what the list of commands says of it."""


class LazyGroup(click.Group):
    """A group that lists its commands from a table, and ends every failure with one line and an exit code."""

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002
        """Return the names of all commands."""
        return sorted(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:  # noqa: ARG002
        """Import a command; None if there is none of this name."""
        if cmd_name not in COMMANDS:
            return None
        module, _ = COMMANDS[cmd_name]
        return import_module(module).command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the list of commands without importing them."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, COMMANDS[name][1]) for name in self.list_commands(ctx)])

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Return the command that the first argument names; an unknown one is an error that names the nearest."""
        name = args[0]
        if name not in COMMANDS and not name.startswith("-") and not ctx.resilient_parsing:
            nearest = difflib.get_close_matches(name, COMMANDS, n=1)
            advice = f"did you mean `{nearest[0]}`?" if nearest else f"choose one of {', '.join(sorted(COMMANDS))}"
            raise click.UsageError(f"there is no command `{name}`; {advice}", ctx=ctx)
        return click.Group.resolve_command(self, ctx, args)

    def main(
        self,
        args: Sequence[str] | None = None,
        prog_name: str | None = None,
        complete_var: str | None = None,
        standalone_mode: bool = True,  # noqa: FBT001, FBT002
        **extra: Any,
    ) -> Any:
        """Run the command line; unless `standalone_mode` is off, end the program with its exit code."""

        def run() -> Any:
            return click.Group.main(self, args, prog_name, complete_var, standalone_mode=False, **extra)

        return sys.exit(exit_code_of(run)) if standalone_mode else run()


@click.group(
    cls=LazyGroup,
    invoke_without_command=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog="Exit codes: 0 done; 1 the program failed; 2 the call or the data are wrong; 3 ran, but the result is not "
    "valid.",
)
@click.option("--version", is_flag=True, help="Show the version and exit.")
@click.pass_context
def main(ctx: click.Context, *, version: bool) -> None:
    """Intermittent-contact atomic force microscopy: impacts, orbits, and the impact law from amplitudes."""
    if version:
        from afm_jax.version import __version__  # noqa: PLC0415

        click.echo(f"afm-jax {__version__}")
        ctx.exit()
    if ctx.invoked_subcommand is None:
        click.echo(ctx.get_help())
