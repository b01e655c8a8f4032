"""``python -m rig`` is ``dea-rig``."""

from rig.cli import main

main(prog_name="dea-rig")
