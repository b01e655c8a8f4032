"""Tables for the terminal."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.console import Console, Group
from rich.table import Table
from rich.text import Text

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from rich.console import RenderableType

    from calibration.film.result import Identification, Quantity
    from calibration.sheet.sheet_tests import TestsFit
    from drivers.discovery import Found as FoundDevice
    from rig.analysis.film import Found
    from rig.analysis.proposal import Proposal
    from rig.analysis.sensors import Calibration
    from rig.analysis.strokes import Stroke
    from rig.experiment import Experiment


def show(*tables: RenderableType) -> None:
    """Print to standard output; as wide as the terminal, at least 100 columns where there is none."""
    console = Console()
    if not console.is_terminal:
        console = Console(width=max(console.width, 120))
    for table in tables:
        console.print(table)


def plan_table(experiment: Experiment) -> Table:
    """The plan: every action with its time and the extremes that the model predicts of it."""
    scene = experiment.scene
    table = Table(
        title=f"{experiment.protocol.title or 'Protocol'} on {scene.specimen.name}",
        caption=(
            f"{len(experiment.actions)} actions, {_minutes(experiment.duration)}. Predicted with the scene's material; "
            f"limits: force {scene.limits.force_N:g} N, displacement {scene.limits.displacement_mm:g} mm"
            + (f", voltage {scene.limits.voltage_V:g} V" if scene.hv is not None else "")
            + ". All hold."
        ),
    )
    table.add_column("step", justify="right")
    table.add_column("action")
    table.add_column("time / s", justify="right")
    table.add_column("peak force / N", justify="right")
    if scene.hv is not None:
        table.add_column("peak field / V/um", justify="right")
        table.add_column("tension margin / kPa", justify="right")
    for action, prediction in zip(experiment.actions, experiment.predictions, strict=True):
        row = [str(action.step), f"{action.kind}: {action.label}", f"{action.duration:.1f}"]
        if action.record or action.moves or action.voltage[0] != action.voltage[1]:
            row.append(f"{prediction.peak_force:.3f}")
            if scene.hv is not None:
                row.append(f"{prediction.peak_field * 1e-6:.1f}")
                row.append(f"{prediction.minimum_hoop_stress * 1e-3:.0f}")
        table.add_row(*row)
    return table


def stroke_table(strokes: Sequence[Stroke]) -> Table:
    """Strokes of virtual biases, measured beside expected."""
    table = Table(title="Stroke and work against a virtual bias", caption="Uncertainties are standard ones (k = 1).")
    table.add_column("step and bias")
    for heading in ("U / V", "stroke / um", "model / um", "off by", "work / mJ", "model / mJ"):
        table.add_column(heading, justify="right", no_wrap=True)
    for one in strokes:
        table.add_row(
            f"{one.step} {one.kind}",
            f"{one.voltage:.0f}",
            f"{one.stroke * 1e6:.1f} +- {one.stroke_uncertainty * 1e6:.1f}",
            _with_error(one.expected_stroke * 1e6, one.expected_stroke_uncertainty * 1e6, 1),
            f"{one.deviation * 100:+.1f} %",
            f"{one.work * 1e3:.4f} +- {one.work_uncertainty * 1e3:.4f}",
            _with_error(one.expected_work * 1e3, one.expected_work_uncertainty * 1e3, 4),
        )
    return table


def _with_error(value: float, error: float, digits: int) -> str:
    """The value, and its uncertainty where one is known."""
    return f"{value:.{digits}f}" + (f" +- {error:.{digits}f}" if error == error else "")


def posterior_table(found: Identification) -> Table:
    """What the Markov chains say, beside the fit."""
    chains = found.posterior
    assert chains is not None
    ended = "" if chains.converged else " TOO SHORT for its autocorrelation: do not rely on it."
    table = Table(
        title="Posterior by Markov chains; gains and dimensions held",
        caption=f"{chains.walkers} walkers, {chains.steps} steps, {chains.acceptance:.0%} accepted, "
        f"autocorrelation {chains.autocorrelation:.0f} steps.{ended}",
    )
    table.add_column("quantity")
    for heading in ("fit", "mean", "standard deviation", "95 % from", "to"):
        table.add_column(heading, justify="right")
    for name, one in chains.quantities.items():
        numbers = (found.quantities[name].value, one.mean, one.deviation, one.low, one.high)
        table.add_row(f"{name} / {one.unit}" if one.unit else name, *(f"{value:.5g}" for value in numbers))
    return table


def calibration_table(found: Calibration) -> list[RenderableType]:
    """What a calibration found, with its budget."""
    tables: list[RenderableType] = []
    characteristic = found.characteristic
    if characteristic is not None:
        from rig.analysis.sensors import UNIT

        unit = UNIT[found.quantity]
        relative = characteristic.gain_uncertainty
        table = Table(title=f"{found.quantity}: {found.instrument or found.quantity} {found.serial}".strip())
        table.add_column("what")
        table.add_column("value", justify="right")
        table.add_column("uncertainty, k = 1", justify="right")
        if found.quantity == "compliance":
            compliance = abs(1e6 / characteristic.gain)
            table.add_row("compliance of the rig / um/N", f"{compliance:.4g}", f"{compliance * relative:.2g}")
        else:
            per = f"{unit} per {found.reading_unit}"
            table.add_row(f"gain / {per}", f"{characteristic.gain:.7g}", f"{characteristic.gain * relative:.2g}")
            factor, unit = (1e6, "um") if unit == "m" else (1.0, unit)
            table.add_row(f"zero / {unit}", f"{characteristic.zero * characteristic.gain * factor:.4g}", "")
            for name, value in (
                ("noise of a sample", characteristic.noise),
                ("zero, with drift", characteristic.zero_uncertainty),
                ("repeatability", characteristic.repeatability),
                ("hysteresis", characteristic.hysteresis),
                ("linearity", characteristic.linearity),
                *([("creep", found.creep)] if found.creep is not None else []),
            ):
                table.add_row(f"{name} / {unit}", f"{value * factor:.2g}", "")
            top = characteristic.high
            expanded = f"{characteristic.expanded_uncertainty(top) * factor:.2g}"
            table.add_row(f"expanded uncertainty at {top * factor:.5g} {unit}, k = 2 / {unit}", expanded, "")
        tables.append(table)
        budget = Table(title="Budget of the gain")
        for heading in ("component", "type", "relative, k = 1", "what it is"):
            budget.add_column(heading)
        for part in sorted(characteristic.budget, key=lambda part: -part.relative):
            budget.add_row(part.name, part.type, f"{part.relative:.1e}", part.note)
        tables.append(budget)
    if found.lags:
        lags = Table(title="Lag behind the stage")
        for heading in ("sensor", "lag / ms", "uncertainty, k = 1 / ms", "hysteresis / um of the stage"):
            lags.add_column(heading, justify="left" if heading == "sensor" else "right")
        for role, lag in sorted(found.lags.items()):
            row = f"{lag.lag * 1e3:.2f}", f"{lag.uncertainty * 1e3:.2f}", f"{lag.standing * 1e6:.2f}"
            lags.add_row(role, *row)
        tables.append(lags)
    if found.quantity == "timing":
        tables.append(Text("For the certificates, above their [findings], in place of what they say of the lag:"))
        tables += [
            Text(f"  {role}: lag_s = {lag.lag:.5f}, lag_uncertainty_s = {lag.uncertainty:.5f}", no_wrap=True)
            for role, lag in sorted(found.lags.items())
        ]
    return tables


def proposal_table(found: Proposal) -> Group:
    """Where the planned protocol holds the film, and what it is expected to tell beside the uniform sweep."""
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
        table.add_row(_NAMES.get(name, name), *(f"{100 * value:.2g}" for value in (*values, *noise)))
    worse = (
        ["For this film the uniform sweep is expected to tell more than these holds; a sweep is the better protocol."]
        if found.gain < 1.0
        else []
    )
    return Group(
        route,
        table,
        *worse,
        f"planned {_minutes(found.planned.duration)}, sweep {_minutes(found.sweep.duration)}, homing to return. The "
        f"sweep would have to record {found.gain:.2g} times as long for the same noise; gains and dimensions gain "
        "nothing by time. What is best depends on the film: after a first run plan with its result (--fit).",
    )


def _minutes(seconds: float) -> str:
    return f"{round(seconds) // 60} min {round(seconds) % 60} s"


def identification_table(found: Identification) -> Group:
    """The identified quantities with their standard uncertainties and verdicts, and what speaks against them."""
    table = _quantities(
        f"Identified with {found.terms} Ogden terms, {found.used} samples, {found.excluded} left out", found.quantities
    )
    lines: list[RenderableType] = [
        table,
        f"reduced chi-square {found.reduced_chi_square:.3f} ({found.freedom} degrees of freedom); stiffness is the "
        f"secant shear modulus at stretches {found.stretch[0]:.2f} (meridional; largest "
        f"{found.stiffness_curve.meridional_stretch[-1]:.2f}) and {found.stretch[1]:.2f} (hoop).",
    ]
    lines += [f"note: {warning}" for warning in found.warnings]
    lines += [f"advice: {advice}" for advice in found.advice]
    if found.blind_spots:
        from calibration.rounding import percent

        worst = found.blind_spots[0]
        shifts = (
            f"{_NAMES.get(name, name)} by {percent(abs(shift / found.quantities[name].value))}"
            for name, shift in found.unseen[worst.name].items()
        )
        lines.append(
            f"unseen: {worst.blind} could be there without showing in these data and shift {', '.join(shifts)}. To "
            f"rule it out: {worst.remedy}. The report lists all {len(found.blind_spots)} that could shift a result by "
            "more than its uncertainty."
        )
    return Group(*lines)


def comparison_table(found: Sequence[Identification]) -> Table:
    """The same data with several numbers of Ogden terms."""
    table = Table(title="Ogden terms: smaller criteria are better, differences below 2 mean nothing")
    for heading in ("terms", "AICc", "BIC", "held out / noise", "not identifiable"):
        table.add_column(heading, justify="left" if heading == "not identifiable" else "right", overflow="fold")
    least = [min(getattr(one, name) for one in found) for name in ("aicc", "bic")]
    for one in found:
        lost = [name for name, quantity in one.quantities.items() if quantity.verdict.startswith("not")]
        predicted = ", ".join(f"{part.ratio:.2f}" for part in one.held_out)
        criteria = (f"{value - low:+.1f}" for value, low in zip((one.aicc, one.bic), least, strict=True))
        table.add_row(str(one.terms), *criteria, predicted or "-", ", ".join(lost) or "-")
    return table


def _quantities(title: str, quantities: Mapping[str, Quantity]) -> Table:
    """Values to the digits of their uncertainties; no number is cut on a narrow terminal."""
    from calibration.rounding import percent, stated

    table = Table(title=title)
    table.add_column("quantity", overflow="fold")
    for heading in ("value", "+-"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("unit", no_wrap=True)
    table.add_column("relative", justify="right", no_wrap=True)
    table.add_column("verdict", overflow="fold")
    for name, quantity in quantities.items():
        factor, unit = _SHOWN.get(quantity.unit, (1.0, quantity.unit))
        table.add_row(
            _NAMES.get(name, name),
            *stated(quantity.value * factor, quantity.uncertainty * factor),
            unit,
            percent(quantity.relative),
            quantity.verdict + (" (at its bound)" if quantity.at_bound else ""),
        )
    return table


def tests_table(found: TestsFit) -> Group:
    """Ogden terms from homogeneous tests, and how much of each test they explain."""
    table = _quantities(f"Identified from homogeneous tests with {len(found.mu)} Ogden terms", found.quantities)
    explained = Table(title="Share of variance explained, R^2")
    explained.add_column("test")
    explained.add_column("fitted", justify="right")
    explained.add_column("predicted", justify="right")
    for name, share in found.r_squared.items():
        explained.add_row(name, _share(share), "")
    for name, share in found.prediction.items():
        explained.add_row(name, "", _share(share))
    return Group(table, explained, *(f"note: {warning}" for warning in found.warnings))


def _share(share: float) -> str:
    """R^2 as text; far below zero, where any constant does better, its digits mean nothing."""
    return f"{share:.5f}" if share >= -10.0 else "< -10"


def truth_table(found: Found) -> RenderableType:
    """The simulation's hidden truth beside what was identified, the difference in stated standard uncertainties."""
    from calibration.film.identify import secant_modulus
    from calibration.rounding import stated

    truth, identification = found.truth, found.identification
    if truth is None:
        return ""
    known = {
        "eps_r": truth.eps_r,
        "stiffness": secant_modulus(truth, *identification.stretch),
        "stiffness_end": secant_modulus(
            truth, identification.stiffness_curve.meridional_stretch[-1], identification.stretch[1]
        ),
        "G": truth.shear_modulus,
    }
    if len(truth.mu) == identification.terms:
        for n, (mu, alpha) in enumerate(sorted(zip(truth.mu, truth.alpha, strict=True), key=lambda term: term[1])):
            known |= {f"mu{n + 1}": mu, f"alpha{n + 1}": alpha}
    table = Table(title="Truth against identified")
    for heading in ("quantity", "truth", "identified", "unit", "+-", "off / +-"):
        table.add_column(heading, justify="left" if heading in ("quantity", "unit") else "right", no_wrap=True)
    for name, quantity in identification.quantities.items():
        if name in known:
            factor, unit = _SHOWN.get(quantity.unit, (1.0, quantity.unit))
            value, uncertainty = stated(quantity.value * factor, quantity.uncertainty * factor)
            off = (quantity.value - known[name]) / quantity.uncertainty
            row = (f"{known[name] * factor:.6g}", value, unit, uncertainty, f"{off:+.2f}")
            table.add_row(_NAMES.get(name, name), *row)
    return table


def devices_table(found: Sequence[FoundDevice]) -> list[RenderableType]:
    """Who answers where, and below it the lines that name them in a scene."""
    if not found:
        return ["The system names no serial port and no CAN channel. Name one with --port or --bus."]
    table = Table(title="Ports and buses")
    for heading in ("where", "role", "driver", "model", "serial number", "firmware", "remark"):
        table.add_column(heading, overflow="fold")
    for one in found:
        who = one.identity
        table.add_row(one.where, one.role, one.driver, who.model, who.serial, who.firmware, one.remark)
    lines: list[RenderableType] = [Text(one.scene) for one in found if one.scene]
    return [table, *(["For the scene:", *lines] if lines else [])]


_SHOWN = {"Pa": (1e-3, "kPa"), "1": (1.0, "")}  # factor and unit in tables
_NAMES = {
    "eps_r": "permittivity",
    "stiffness": "stiffness (best)",
    "stiffness_end": "stiffness (end)",
    "G": "shear modulus",
}
