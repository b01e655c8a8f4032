"""The sections of the report, one file each; `calibration.report.sections.registry` finds them."""
