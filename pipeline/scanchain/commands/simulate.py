"""``scanchain simulate``: a log with ground truth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from scanchain.errors import InputError, counted


@click.command()
@click.argument("world", metavar="WORLD")
@click.argument("destination", metavar="DST.mcap", type=click.Path(path_type=Path))
@click.option(
    "--seed", default=0, show_default=True, metavar="N", help="Random seed; the same seed gives the same bytes."
)
@click.option(
    "--duration", "duration_s", type=float, metavar="SECONDS", help="Length of the drive. [default: the world's]"
)
@click.option("--sensor", metavar="NAME", help="Lidar: lms-270, utm-30, hdl-64, os1-32, vlp-16 or rosette.")
@click.option(
    "--drift", default=1.0, show_default=True, metavar="FACTOR", help="Scale of the errors of the wheel odometry."
)
@click.option(
    "--wheels-slip",
    nargs=3,
    type=float,
    metavar="START END METERS",
    help="Let the wheels turn so far ahead between these seconds, and the robot not move by it.",
)
@click.option(
    "--noise",
    "noise_m",
    type=float,
    metavar="METERS",
    help="Standard deviation of the ranges. [default: the sensor's]",
)
@click.option(
    "--dropout", type=float, metavar="SHARE", help="Share of returns that are lost. [default: the sensor's]"
)
@click.option(
    "--changed",
    type=click.IntRange(0),
    metavar="N",
    help="Drive again on another day, number N: furniture or parked cars came, went and moved.",
)
@click.option("--reverse", is_flag=True, help="Drive the route the other way round.")
@click.option(
    "--start-at", "start_m", default=0.0, show_default=True, metavar="METERS", help="Begin so far along the route."
)
@click.option("--force", is_flag=True, help="Replace an existing file.")
def simulate(
    world: str, destination: Path, wheels_slip: tuple[float, float, float] | None, **options: Any
) -> None:
    """Write a synthetic log with exact ground truth, and the truth beside it as .tum.

    \b
    WORLD is one of
      office     rooms and corridors, 2D laser scanner
      town       streets on rolling ground
      rounds     the town without parked cars, its streets driven again in both directions
      identical  identical corridors and rooms, 2D laser scanner
      highway    guard rails and signs at 25 m/s, from the first scan on
      corridor   80 m between bare walls: motion along it is unobservable but at its ends
      field      flat, a few poles far apart: between them only the ground is visible
      forest     trunks and crowns on rough ground
      staircase  four stories, walked with a handheld lidar
      hall       flat floor, few pillars, from standstill to 5 m/s
      turns      turns on the spot at 120 deg/s and short moves in a yard
      gap        the town, but one second of scans is missing in a bend, and one on a straight
    All but office and identical are driven with a 3D lidar by default. With --changed the world is the one of the
    same seed, and what is different in it (in office, identical, town, rounds, gap) is listed in DST.changes.csv.

    \b
    Examples:
      scanchain simulate office office.mcap
      scanchain simulate town town.mcap --duration 20 --seed 3
      scanchain simulate highway fast.mcap --sensor os1-32
      scanchain simulate office later.mcap --changed 1
      scanchain simulate town sparse.mcap --sensor vlp-16 --noise 0.05 --dropout 0.1
      scanchain simulate town again.mcap --changed 1 --reverse --start-at 100
      scanchain simulate office slips.mcap --wheels-slip 20 24 3
    """
    if destination.suffix != ".mcap":
        raise InputError(f"{destination}: does not end in .mcap; name it {destination.with_suffix('.mcap')}")
    from scanchain.commands.terminal import Terminal
    from scanchain.simulation import NO_SLIP, Slip
    from scanchain.simulation import simulate as simulate_log

    with Terminal("scans") as terminal:
        slip = NO_SLIP if wheels_slip is None else Slip(*wheels_slip)
        truth = simulate_log(world, destination, wheels_slip=slip, progress=terminal.count, **options)
    size_mb = destination.stat().st_size / 1e6
    click.echo(
        f"{destination}: {counted(len(truth), 'scan')}, {size_mb:.1f} MB; ground truth in it and in "
        f"{destination.with_suffix('.tum')}"
    )
