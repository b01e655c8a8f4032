"""Tables that other programs wrote: understood, checked, and made into tests of sheets or curves of a cone."""
