"""Which of the mutants that stand in the copied sources is on: `.ci/mutants` writes `on(17)` where the 17th may act.

Processes that a test starts read it from their environment, so that a mutant also acts in them. Where
``DEA_MUTANT_HITS`` names a file, each place notes there, once a test, that the test executed it.
"""

from __future__ import annotations

import os

active = int(os.environ.get("DEA_MUTANT", "0"))
hits = os.environ.get("DEA_MUTANT_HITS", "")
_noted: set[tuple[int, str]] = set()


def on(number: int) -> bool:
    """Whether this mutant acts; notes that its place was executed."""
    if hits:
        test = os.environ.get("PYTEST_CURRENT_TEST", "")
        if (number, test) not in _noted:
            _noted.add((number, test))
            with open(hits, "a", encoding="utf-8") as file:  # noqa: PTH123 (imported by every process; keep it light)
                file.write(f"{number} {test}\n")
    return number == active
