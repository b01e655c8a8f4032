"""The panel's numbers in a terminal, for where there is no browser."""

from __future__ import annotations

import time
from pathlib import Path

from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from rig.operator.live import live_run
from rig.panel.run_view import OLD_S, RunView

LOOK_S = 0.2
COLOURS = {
    "SAFE": "white on green4",
    "ARMED": "black on yellow",
    "LIVE": "white on dark_orange3",
    "NOT SAFE": "bold white on red",
    "UNKNOWN": "bold white on purple",
    "NO HIGH VOLTAGE": "white on blue",
}
NUMBERS = {
    "force_mN": ("force", "mN"),
    "displacement_mm": ("displacement", "mm"),
    "voltage_V": ("voltage", "V"),
    "current_uA": ("current", "uA"),
    "second_V": ("second reading", "V"),
    "measured_temperature_C": ("air", "C"),
    "measured_humidity_percent": ("humidity", "%"),
}


def watch(log: Path | None, console: Console | None = None) -> None:
    """Show the run that writes ``log``, or the one that is going on, until it ends or Ctrl-C is pressed.

    Raises
    ------
    ConfigError
        No run is going on, or it is not clear which one is meant.
    LogError
        The log cannot be read.
    """
    if log is None:
        log = Path(live_run().log)
    view = RunView(log.resolve())
    console = console or Console()
    try:
        with Live(console=console, auto_refresh=False) as live:
            while True:
                page = view.page({"outlook": True})
                live.update(_table(page), refresh=True)
                if page["ended"]:
                    return
                time.sleep(LOOK_S)
    except KeyboardInterrupt:
        pass
    finally:
        view.close()


def _table(page: dict[str, object]) -> Table:
    """One page as lines that fit 80 columns."""
    table = Table.grid(padding=(0, 2))
    state = str(page["state"])
    table.add_row(Text(f" {state} ", COLOURS[state]), Text("SIMULATED" if page["simulated"] else "REAL PORTS", "bold"))
    age = page["age_s"]
    if isinstance(age, float) and age > OLD_S:
        table.add_row(Text("old data", "bold black on yellow"), Text(f"nothing new for {age:.0f} s"))
    latest, phase, left = page["latest"], page["phase"], page["time_left_s"]
    assert isinstance(latest, dict)
    for name, (word, unit) in NUMBERS.items():
        if latest.get(name) is not None:
            table.add_row(word, f"{latest[name]:.4g} {unit}")
    if isinstance(phase, dict):
        table.add_row("step", Text(f"{phase['step']} {phase['kind']}: {phase['label']}"))
    if isinstance(left, float):
        table.add_row("time left", f"{left:.0f} s by the plan")
    outcome, control = page["outcome"], page["control"]
    if isinstance(outcome, dict):
        table.add_row("outcome", Text(f"{outcome['status']}: {outcome['reason']}"))
    elif isinstance(control, dict) and control.get("question"):
        table.add_row("question", Text(str(control["question"])))
    if not page["ended"]:
        table.add_row("", Text("stop it from any terminal: dea-rig stop", "dim"))
    return table
