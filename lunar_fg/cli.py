"""The command line: which commands there are. Each is a file in `lunar_fg.commands`."""

from __future__ import annotations

import logging
from typing import Annotated

import typer
from rich.logging import RichHandler

from lunar_fg import __version__
from lunar_fg.commands.campaign import campaign
from lunar_fg.commands.demo import demo
from lunar_fg.commands.doctor import doctor
from lunar_fg.commands.evaluate import evaluate
from lunar_fg.commands.export import export
from lunar_fg.commands.fixes import fixes
from lunar_fg.commands.inspect import inspect
from lunar_fg.commands.locate import locate_command
from lunar_fg.commands.map import terrain_map
from lunar_fg.commands.match import match
from lunar_fg.commands.mosaic import mosaic
from lunar_fg.commands.optimize import optimize
from lunar_fg.commands.pointing import pointing
from lunar_fg.commands.replay import replay
from lunar_fg.commands.report import report
from lunar_fg.commands.resume import resume
from lunar_fg.commands.run import run
from lunar_fg.commands.shared import err, guarded, out
from lunar_fg.commands.simulate import simulate
from lunar_fg.commands.warmup import warmup

app = typer.Typer(
    name="lunar-fg",
    help="""Rover navigation from stereo images: SURF, stereo geometry, one GTSAM factor graph.

    First steps:

    \b
    lunar-fg doctor                          is everything installed?
    lunar-fg demo                            a whole drive, without any data
    lunar-fg run MY-TRAVERSE -o runs/first   navigate through stereo images
    lunar-fg report runs/first               one page on what came out
    lunar-fg run --help                      help on a command, with an example
    """,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


@app.callback(invoke_without_command=True)
def main(
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
) -> None:
    """Rover navigation from stereo images."""
    logging.basicConfig(
        level=logging.WARNING,
        format="%(message)s",
        handlers=[RichHandler(console=err, show_time=False, show_path=False, show_level=False)],
    )
    if version:
        out.print(__version__)
        raise typer.Exit


app.command()(guarded(run))
app.command()(guarded(resume))
app.command()(guarded(replay))
app.command()(guarded(optimize))
app.command(name="eval")(guarded(evaluate))
app.command()(guarded(demo))
app.command()(guarded(doctor))
app.command()(guarded(warmup))
app.command()(guarded(match))
app.command()(guarded(campaign))
app.command()(guarded(export))
app.command()(guarded(fixes))
app.command()(guarded(mosaic))
app.command(name="locate")(guarded(locate_command))
app.command(name="map")(guarded(terrain_map))
app.command()(guarded(report))
app.command()(guarded(simulate))
app.command()(guarded(pointing))
app.command()(guarded(inspect))

if __name__ == "__main__":
    app()
