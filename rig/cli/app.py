"""The command line: thin commands over the rooms of the house.

Heavy things are imported inside the commands that use them, so that ``dea-rig --help`` answers at once.
"""

from __future__ import annotations

import json
import os
import sys
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import click

from rig.cli.benchmark import benchmark

FILE = click.Path(path_type=Path, dir_okay=False)


class Commands(click.Group):
    """A group in which an error for the operator is a message and an exit code, never a traceback."""

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
            click.secho(str(error), err=True, fg="red")
            for note in getattr(error, "__notes__", []):
                click.echo(note, err=True)
            ctx.exit(code)


def _exit_code(error: Exception) -> int | None:
    """The exit code of an error that is meant for the operator; None for a mistake of ours."""
    from drivers.links.link import DeviceError
    from rig.base.errors import RigError

    if isinstance(error, RigError):
        return error.exit_code
    if isinstance(error, DeviceError):
        return 4
    return 1 if isinstance(error, OSError) else None  # the disk or terminal that was to be written to


EXIT_CODES = """Exit codes: 0 done; 1 nothing useful came of it; 2 a file or option cannot be used, nothing was touched;
3 a limit; 4 a fault of the rig; 130 stopped by the operator."""


@click.group(cls=Commands, context_settings={"help_option_names": ["-h", "--help"]}, epilog=EXIT_CODES)
@click.version_option(package_name="dea-rig")
def main() -> None:
    """Characterise conical dielectric elastomer actuators on a bench, real or simulated.

    Start with `dea-rig demo`. Software is not the safety function: interlock, emergency stop, current limit and
    bleed resistor are.
    """


@main.command()
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), help="Directory to make.")
@click.option("--seed", type=click.IntRange(0, 2**32 - 1), default=1, show_default=True, help="Seed of the simulation.")
def demo(out: Path | None, seed: int) -> None:
    """Characterise two simulated specimens, start to finish, and compare with the truth."""
    from rig.demo import run_demo

    run_demo(out, seed)


@main.command()
@click.argument("scene", type=FILE)
@click.argument("protocol", type=FILE)
def check(scene: Path, protocol: Path) -> None:
    """Validate SCENE and PROTOCOL and print the plan with what the model predicts. Touches no hardware."""
    from rig.cli.show import plan_table, show
    from rig.experiment import prepare

    experiment = prepare(scene, protocol)
    show(plan_table(experiment))


@main.command()
@click.argument("scene", type=FILE)
@click.argument("protocol", type=FILE)
@click.option("-o", "--out", type=FILE, required=True, help="Log to write; never overwrites.")
@click.option(
    "--ports",
    type=click.Path(path_type=Path, dir_okay=False, allow_dash=True),
    help="Ports by role as `dea-rig sim` prints them; in place of the scene's.",
)
@click.option("--arm", is_flag=True, help="Allow high voltage on real ports; the highest voltage is asked for too.")
@click.option("--yes", is_flag=True, help="Answer every question as expected: for unattended simulated benches.")
@click.option("--take-down", is_flag=True, help="Ramp down an output that is found live; default: ask.")
def run(scene: Path, protocol: Path, out: Path, ports: Path | None, arm: bool, yes: bool, take_down: bool) -> None:
    """Run PROTOCOL on the bench of SCENE and log every byte. Ctrl-C ends it safely, Ctrl-Z or p pauses it."""
    from rig.base.outputs import check_new
    from rig.cli.running import run_and_tell
    from rig.experiment import prepare

    check_new(out)
    experiment = prepare(scene, protocol, _read_ports(ports) if ports is not None else None)
    run_and_tell(experiment, out, arm=arm, yes=yes, take_down=take_down)


@main.command()
@click.argument("log", type=FILE)
@click.option("-o", "--out", type=FILE, required=True, help="Log to write; never overwrites.")
@click.option("--ports", type=FILE, help="Ports by role, as for `dea-rig run`.")
@click.option("--arm", is_flag=True, help="As for `dea-rig run`.")
@click.option("--yes", is_flag=True, help="As for `dea-rig run`.")
@click.option("--take-down", is_flag=True, help="As for `dea-rig run`.")
def resume(log: Path, out: Path, ports: Path | None, arm: bool, yes: bool, take_down: bool) -> None:
    """Go on with the run in LOG that ended early: its next step, the same specimen, the same instruments."""
    from rig.base.outputs import check_new
    from rig.cli.running import run_and_tell
    from rig.run.resume import prepare_resumed

    check_new(out)
    experiment = prepare_resumed(log, _read_ports(ports) if ports is not None else None)
    run_and_tell(experiment, out, arm=arm, yes=yes, take_down=take_down)


@main.command()
@click.argument("log", required=False, type=FILE)
def stop(log: Path | None) -> None:
    """End the run that is going on, as Ctrl-C does; a second time hastens it. LOG names the run."""
    from rig.cli.running import wish

    wish("stop", log)


@main.command()
@click.argument("log", required=False, type=FILE)
def pause(log: Path | None) -> None:
    """Pause the run that is going on: the stage stops, the voltage ramps to zero. LOG names the run."""
    from rig.cli.running import wish

    wish("pause", log)


@main.command("continue")
@click.argument("log", required=False, type=FILE)
def continue_(log: Path | None) -> None:
    """Continue a paused run, or answer what a run asks. LOG names the run if there are several."""
    from rig.cli.running import wish

    wish("continue", log)


@main.command()
@click.argument("quantity", type=click.Choice(["force", "displacement", "compliance", "hv", "timing"]))
@click.argument("source", type=FILE)
@click.option("-o", "--out", type=click.Path(path_type=Path, file_okay=False), required=True, help="Directory.")
@click.option("--protocol", type=FILE, help="Steps to run in place of the usual ones.")
@click.option("--valid-days", type=click.IntRange(1, 3650), default=365, show_default=True, help="Of the certificate.")
@click.option("--arm", is_flag=True, help="Allow high voltage on real ports (hv only).")
@click.option("--yes", is_flag=True, help="Answer every question as expected: for unattended simulated benches.")
def calibrate(
    quantity: Any, source: Path, out: Path, protocol: Path | None, valid_days: int, arm: bool, yes: bool
) -> None:
    """Calibrate an instrument on the bench of SOURCE, a scene, and write its certificate; or from SOURCE, a log.

    force: weights. displacement: the laser against the stage. compliance: the rig, against a rigid dummy. hv: the
    monitor against a reference meter. timing: how far laser and force lag behind the stage.
    """
    from rig.calibrate.command import calibrate as calibrate_
    from rig.cli.running import run_and_tell
    from rig.cli.show import calibration_table, show

    def run(experiment: Any, log: Path) -> None:
        run_and_tell(experiment, log, arm=arm, yes=yes, take_down=False)

    found, written = calibrate_(quantity, source, out, run, protocol, valid_days)
    show(*calibration_table(found))
    for path in written:
        click.echo(f"written: {path}")


@main.command()
@click.argument("log", type=FILE)
@click.option("-o", "--out", type=FILE, help="The table as CSV.")
@click.option("--picture", type=FILE, help="PNG or SVG.")
@click.option("--fit", type=FILE, help="Result of `dea-rig fit`: expect what that film does, not the scene's.")
def stroke(log: Path, out: Path | None, picture: Path | None, fit: Path | None) -> None:
    """Stroke and work against a virtual spring, mass or second cone in LOG: measured beside expected."""
    from rig.commands.stroke import tell_strokes

    tell_strokes(log, out, picture, fit)


@main.command()
@click.argument("quantity", type=click.Choice(["force", "displacement", "hv"]))
@click.argument("scene", type=FILE)
@click.option("--standard", type=click.FloatRange(min=0, min_open=True), required=True, help="In g, mm or V.")
@click.option("-o", "--out", type=FILE, required=True, help="Log to write; never overwrites.")
@click.option("--arm", is_flag=True, help="Allow high voltage on real ports (hv only).")
@click.option("--yes", is_flag=True, help="Answer every question as expected: for unattended simulated benches.")
def verify(quantity: Any, scene: Path, standard: float, out: Path, arm: bool, yes: bool) -> None:
    """Daily one-point check: does the sensor still agree with its certificate? Exit code 1 if not."""
    from rig.calibrate.command import verify as verify_
    from rig.cli.running import run_and_tell

    def run(experiment: Any, log: Path) -> None:
        run_and_tell(experiment, log, arm=arm, yes=yes, take_down=False)

    found = verify_(quantity, scene, standard, out, run)
    factor, unit = (1e3, "mm") if found.unit == "m" else (1.0, found.unit)
    click.echo(
        f"{quantity}: applied {found.applied * factor:.6g} {unit}, measured {found.measured * factor:.6g} {unit}, "
        f"U = {found.uncertainty * factor:.2g} {unit} (k = 2), E_n = {found.normalised_error:+.2f}: "
        + ("the certificate holds." if found.passed else "DOES NOT AGREE. Calibrate anew before you measure.")
    )
    if not found.passed:
        sys.exit(1)


@main.command()
@click.argument("scene", type=FILE)
def sim(scene: Path) -> None:
    """Serve the simulated bench of SCENE, or the log in its place, on pseudo-terminals; prints the ports as JSON."""
    from rig.base.clock import RealClock
    from rig.base.errors import ConfigError
    from rig.bench.bench import wired_bench
    from rig.operator.signals import stop_on_signals
    from rig.scene.scene import load_scene

    if os.name != "posix":
        raise ConfigError("The bench is served on pseudo-terminals, which this system lacks. Run it in memory.")
    from rig.sim.server import Server

    loaded, _ = load_scene(scene)
    server = Server(wired_bench(loaded, real_time=True), RealClock())
    with stop_on_signals() as stop:
        try:
            click.echo(json.dumps(server.ports))
            server.run(lambda: stop.count > 0)
        finally:
            server.close()


@main.command()
@click.argument("logs", nargs=-1, required=True, type=FILE)
@click.option("-o", "--out", type=FILE, help="Result as JSON.")
@click.option("--report", type=FILE, help="Result as one self-contained HTML page.")
@click.option("--terms", type=click.IntRange(1, 3), default=2, show_default=True, help="Ogden terms.")
@click.option("--compare", "comparing", is_flag=True, help="Judge 1, 2 and 3 terms: AICc, BIC, held-out curves.")
@click.option("--profiles", is_flag=True, help="95 % intervals from profile likelihood too; takes longer.")
@click.option("--posterior", is_flag=True, help="Markov chains too (extra `posterior`); takes a minute or more.")
@click.option(
    "--wrinkled",
    type=click.Choice(["left-out", "tension-field"]),
    default="left-out",
    show_default=True,
    help="Samples at which the film is wrinkled: leave out, or describe by the tension field. Counted either way.",
)
def fit(
    logs: tuple[Path, ...],
    out: Path | None,
    report: Path | None,
    terms: int,
    comparing: bool,
    profiles: bool,
    posterior: bool,
    wrinkled: str,
) -> None:
    """Identify Ogden parameters and permittivity from all curves of LOGS at once, with uncertainties."""
    from rig.analysis.film import identify_logs, write_results
    from rig.base.outputs import check_new
    from rig.base.progress import progress
    from rig.cli.show import comparison_table, identification_table, posterior_table, show

    check_new(out, report)
    with progress("Markov chains around the fit") if posterior else nullcontext(lambda *_: None) as update:
        found = identify_logs(
            list(logs),
            terms=terms,
            comparing=comparing,
            profiles=profiles,
            wrinkled=wrinkled,
            posterior=posterior,
            progress=update,
        )
    write_results(found, out, report)
    tables = [comparison_table(found.comparison)] if comparing else []
    tables += [posterior_table(found.identification)] if posterior else []
    show(identification_table(found.identification), *tables, *(f"note: {note}" for note in found.notes))
    for path in (out, report):
        if path is not None:
            click.echo(f"written: {path}")


@main.command("fit-tests")
@click.argument("tests", nargs=-1, required=True, type=FILE)
@click.option("-o", "--out", type=FILE, help="Result as JSON.")
@click.option("--terms", type=click.IntRange(1, 4), default=3, show_default=True, help="Ogden terms.")
@click.option("--predict", multiple=True, type=FILE, help="A test that takes no part and is predicted.")
def fit_tests(tests: tuple[Path, ...], out: Path | None, terms: int, predict: tuple[Path, ...]) -> None:
    """Identify Ogden parameters from homogeneous TESTS (CSV) of a sheet, all at once.

    Columns are stretch and nominal_stress_MPa (or _kPa, _Pa); for biaxial tests stretch1, stretch2,
    nominal_stress1_MPa, nominal_stress2_MPa. A remark "# kind: uniaxial" (equibiaxial, pure shear, biaxial), or the
    file's name, says which test it is.
    """
    from rig.analysis.film import identify_tests, write_text
    from rig.base.outputs import check_new
    from rig.cli.show import show, tests_table

    check_new(out)
    found = identify_tests(tests, predict, terms)
    if out is not None:
        write_text(out, found.to_json())
    show(tests_table(found))
    if out is not None:
        click.echo(f"written: {out}")


@main.command("plan")
@click.argument("scene", type=FILE)
@click.option("--time", "time", required=True, help="Time of the rig, with its unit: 10min, 300s, 1.5h.")
@click.option("--fit", type=FILE, help="Result of `dea-rig fit` on a first run: plan for that film, not the scene's.")
@click.option("--terms", type=click.IntRange(1, 2), default=2, show_default=True, help="Ogden terms to be fitted.")
@click.option("-o", "--out", type=FILE, help="Protocol to write; never overwrites.")
def plan_command(scene: Path, time: str, fit: Path | None, terms: int, out: Path | None) -> None:
    """Propose where to hold the film of SCENE, and how long, to learn most about it in the given time.

    Compares what the protocol is expected to tell with the uniform sweep in the same time. Touches no hardware.
    """
    from rig.analysis.film import write_text
    from rig.analysis.fit_file import read_fit
    from rig.analysis.proposal import parse_time, propose_protocol
    from rig.base.outputs import check_new
    from rig.cli.show import proposal_table, show
    from rig.scene.scene import load_scene

    check_new(out)
    film = None if fit is None else read_fit(fit, load_scene(scene)[0].specimen.specimen().material).material
    found = propose_protocol(scene, parse_time(time), film, terms=terms)
    if out is not None:
        write_text(out, found.text)
    show(proposal_table(found))
    if out is not None:
        click.echo(f"written: {out}")


@main.command()
@click.argument("log", type=FILE)
@click.option("--save", type=FILE, help="Write a Rerun recording instead of opening the viewer.")
@click.option("--screenshot", type=FILE, help="Write a picture instead of opening the viewer; needs no display.")
def view(log: Path, save: Path | None, screenshot: Path | None) -> None:
    """Open LOG in the Rerun viewer, on this machine only."""
    from rig.base.outputs import check_new
    from rig.view.recording import view as view_log

    check_new(save, screenshot)
    view_log(log, save=save, screenshot=screenshot)
    for path in (save, screenshot):
        if path is not None:
            click.echo(f"written: {path}")


@main.command()
@click.argument("cases", type=click.Path(path_type=Path, dir_okay=False, allow_dash=True))
def solve(cases: Path) -> None:
    """Solve the films in CASES.json (- reads standard input) and print the answers as JSON.

    Exit code 1 when not a single case describes a film.

    CASES is a list of objects in SI units with id, a, b, thickness, prestretch, h, voltage, wrinkling ("plain" or
    "tension_field"), material {mu, alpha, eps_r} and optionally tolerance.
    """
    from rig.analysis.cases import CaseError, solve_cases
    from rig.base.errors import ConfigError

    try:
        answers = solve_cases(_read_json(cases, "cases"))
    except CaseError as error:
        raise ConfigError(f"{cases}: {error}.") from None
    click.echo(json.dumps(answers, indent=2))
    if answers and all(answer["status"] == "invalid" for answer in answers):
        click.get_current_context().exit(1)


main.add_command(benchmark)


@main.command()
@click.argument("study", type=FILE)
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), default="designs", show_default=True)
@click.option("--workers", type=click.IntRange(1, 256), default=1, show_default=True, help="Processes for maps.")
@click.option("--dask", metavar="ADDRESS", help="Dask scheduler that carries maps, e.g. tcp://10.0.0.5:8786.")
@click.option("--compare", is_flag=True, help="Time the paper's shooting method on a sample of a map too.")
def design(study: Path, out: Path, workers: int, dask: str | None, compare: bool) -> None:
    """Carry out STUDY (TOML): pictures, CSV, and the paper's claims beside the same computed here."""
    from rig.commands.design import carry_out

    carry_out(study, out, workers, dask, compare)


@main.command()
@click.option("--port", "ports", multiple=True, help="Ask on this serial port only.")
@click.option("--bus", "buses", multiple=True, metavar="INTERFACE:CHANNEL[@BITRATE]", help="Ask on this CAN bus only.")
def devices(ports: tuple[str, ...], buses: tuple[str, ...]) -> None:
    """List who answers on which port and bus, and propose the lines for a scene. Sends only questions."""
    from drivers.discovery import Bus, discover
    from rig.base.clock import RealClock
    from rig.cli.show import devices_table, show

    try:
        named = [Bus.parse(text) for text in buses]
    except ValueError as error:
        raise click.BadParameter(f"{error}.", param_hint="--bus") from None
    everywhere = not (ports or buses)
    found = discover(RealClock(), None if everywhere else ports, None if everywhere else named)
    show(*devices_table(found))
    if not everywhere and not all(one.role for one in found):
        click.get_current_context().exit(1)


@main.command()
@click.argument("log", type=FILE)
def info(log: Path) -> None:
    """What is in LOG: run, devices, channels and rates, gaps, outcome."""
    from rig.log.info import info as describe

    click.echo(describe(log))


@main.command()
@click.argument("log", type=FILE)
@click.option("-o", "--out", type=FILE, required=True, help="Log to write.")
def recover(log: Path, out: Path) -> None:
    """Save what can be read of a damaged LOG. Exit code 0: all of it; 3: part of it; 1: nothing."""
    from rig.log.recover import recover as rescue

    recovery = rescue(log, out)
    click.echo(recovery.report)
    click.get_current_context().exit(recovery.exit_code)


@main.command()
@click.argument("log", type=FILE)
@click.option("--verify", is_flag=True, help="Recorded bytes through today's drivers: the same samples?")
@click.option("--rerun", is_flag=True, help="Today's engine and drivers, answered by LOG: the same requests?")
def replay(log: Path, verify: bool, rerun: bool) -> None:
    """Hold today's software against LOG; without an option, in both ways.

    The first difference is reported: for --verify with the byte offset in what the instrument sent, its bytes, what was
    recorded and what is decoded today; for --rerun with both requests in hex and the step of the protocol.

    Exit code 0: all is as recorded; 3: all is, as far as the log is whole (it says how far); 1: something differs, or
    the log cannot be used.
    """
    from rig.replay.recording import load_recording
    from rig.replay.rerun import rerun as run_again
    from rig.replay.verify import verify as verify_samples

    recording = load_recording(log)
    both = not (verify or rerun)
    found = [do(recording) for do, asked in ((verify_samples, verify), (run_again, rerun)) if asked or both]
    for result in found:
        click.echo(result.report)
    codes = {result.exit_code for result in found}
    click.get_current_context().exit(1 if 1 in codes else max(codes))


@main.command()
@click.argument("log", type=FILE)
@click.option("-o", "--out", type=FILE, required=True, help="File to write: .csv or .parquet.")
@click.option("--topic", help="One channel as recorded; default: the aligned run.")
def export(log: Path, out: Path, topic: str | None) -> None:
    """Write LOG as a table, with units in the header."""
    from rig.log.export import export as write

    click.echo(f"{out}: {write(log, out, topic)} rows")


def _read_ports(path: Path) -> dict[str, dict[str, Any]]:
    from rig.base.errors import ConfigError

    ports = _read_json(path, "ports")
    if not isinstance(ports, dict) or not all(isinstance(value, dict) for value in ports.values()):
        raise ConfigError(f"{path}: not the JSON that `dea-rig sim` prints: a table of ports by role is needed.")
    return ports


def _read_json(path: Path, kind: str) -> Any:
    from rig.base.errors import ConfigError
    from rig.base.toml_file import read_text

    text = sys.stdin.read() if str(path) == "-" else read_text(path, kind)
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: not a JSON file of {kind}: {error}.") from None
