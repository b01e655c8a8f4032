"""``dea-rig plan``: propose a protocol that tells most about a film in a given time."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from rig.cli.files import FILE, tell_written

if TYPE_CHECKING:
    from rich.console import Group

    from rig.analysis.proposal import Proposal
    from rig.analysis.relax_proposal import RelaxProposal


@click.command("plan")
@click.argument("scene", type=FILE)
@click.option("--time", "time", required=True, help="Time of the rig, with its unit: 10min, 300s, 1.5h.")
@click.option("--fit", type=FILE, help="Result of `dea-rig fit` on a first run: plan for that film, not the scene's.")
@click.option("--terms", type=click.IntRange(1, 2), default=2, show_default=True, help="Ogden terms to be fitted.")
@click.option("-o", "--out", type=FILE, help="Protocol to write; never overwrites.")
def command(scene: Path, time: str, fit: Path | None, terms: int, out: Path | None) -> None:
    """Propose where to hold the film of SCENE, and how long, to learn most about it in the given time.

    For a film with branches, by the scene or by --fit, it proposes quick moves with holds.
    Compares what the protocol is expected to tell with the uniform sweep in the same time. Touches no hardware.
    """
    from rig.analysis.fit_file import read_fit
    from rig.analysis.proposal import parse_time, propose_protocol
    from rig.base.outputs import check_new, write_text
    from rig.cli.show import show
    from rig.scene.scene import load_scene

    check_new(out)
    believed = load_scene(scene)[0].specimen.specimen().material
    film = None if fit is None else read_fit(fit, believed).material
    if (film or believed).branches:
        from rig.analysis.relax_proposal import propose_relaxation

        relaxing = propose_relaxation(scene, parse_time(time), film)
        if out is not None:
            write_text(out, relaxing.text)
        show(relaxation_table(relaxing))
        tell_written(out)
        return
    found = propose_protocol(scene, parse_time(time), film, terms=terms)
    if out is not None:
        write_text(out, found.text)
    show(proposal_table(found))
    tell_written(out)


def relaxation_table(found: RelaxProposal) -> Group:
    """Moves and holds of the planned protocol, and what it is expected to tell of the film and its branches."""
    from rich.console import Group
    from rich.table import Table

    from rig.cli.show import NAMES, minutes

    steps = Table(title=found.planned.protocol.title)
    for heading in ("voltage / V", "speed / mm/s", "hold / s", "held at / mm"):
        steps.add_column(heading, justify="right")
    voltage = 0.0
    for step in found.planned.protocol.step:
        values = step.model_dump()
        if step.kind == "voltage":
            voltage = values["voltage_V"]
        elif step.kind == "relax":
            held = ", ".join(f"{one:g}" for one in values["displacements_mm"])
            steps.add_row(f"{voltage:g}", f"{values['speed_mm_per_s']:g}", f"{values['hold_s']:.1f}", held)
    table = Table(title="Expected relative standard uncertainty by noise and zeros, %")
    for heading in ("quantity", "planned", "uniform sweep"):
        table.add_column(heading, justify="left" if heading == "quantity" else "right")
    names: dict[str, str] = {}
    for k, one in enumerate(found.film.branches, start=1):
        names |= {
            f"ratio{k}": f"ratio of the branch of {one.time:g} s",
            f"time{k}": f"time of the branch of {one.time:g} s",
        }
    for name, value in found.planned.expected.items():
        label = names.get(name) or NAMES.get(name, name)
        table.add_row(label, f"{100 * value:.2g}", f"{100 * found.sweep.expected[name]:.2g}")
    return Group(
        steps,
        table,
        f"planned {minutes(found.planned.duration)}, sweep {minutes(found.sweep.duration)}, homing to return. Holds "
        "tell slow branches, quick moves the fast ones; the stiffness is that of the relaxed film. Fit it with "
        "`dea-rig fit --branches auto`.",
    )


def proposal_table(found: Proposal) -> Group:
    """Where the planned protocol holds the film, and what it is expected to tell beside the uniform sweep."""
    from rich.console import Group
    from rich.table import Table

    from rig.cli.show import NAMES, minutes

    route = Table(title=found.planned.protocol.title)
    for heading in ("voltage / V", "displacement / mm", "hold / s"):
        route.add_column(heading, justify="right")
    for dwell in found.route:
        route.add_row(f"{dwell.voltage:g}", f"{1e3 * dwell.h:.2f}", f"{dwell.seconds:.1f}")
    table = Table(title="Expected relative standard uncertainty, %")
    table.add_column("quantity", no_wrap=True)
    for heading in ("planned", "uniform sweep", "planned, noise and zeros", "sweep, noise and zeros"):
        table.add_column(heading, justify="right")
    for name in found.wanted:
        values = (design[name] for design in (found.planned.combined, found.sweep.combined))
        noise = (design[name] for design in (found.planned.random, found.sweep.random))
        table.add_row(NAMES.get(name, name), *(f"{100 * value:.2g}" for value in (*values, *noise)))
    worse = (
        ["For this film the uniform sweep is expected to tell more than these holds; a sweep is the better protocol."]
        if found.gain < 1.0
        else []
    )
    return Group(
        route,
        table,
        *worse,
        f"planned {minutes(found.planned.duration)}, sweep {minutes(found.sweep.duration)}, homing to return. The "
        f"sweep would have to record {found.gain:.2g} times as long for the same noise; gains and dimensions gain "
        "nothing by time. What is best depends on the film: after a first run plan with its result (--fit).",
    )
