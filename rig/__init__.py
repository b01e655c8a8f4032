"""Everything that runs: scenes, protocols, bench, engine, log, simulated bench, view, command line."""
