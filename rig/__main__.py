"""``python -m rig`` is ``dea-rig``."""

from rig.cli.app import main

main(prog_name="dea-rig")
