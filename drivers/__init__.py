"""One module per instrument: bytes on one side, samples on the other. Imports nothing of ours."""
