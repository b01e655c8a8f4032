"""The live view of a run: follows the growing log from outside, and speaks to the run through `rig.operator`."""
