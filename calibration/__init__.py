"""From counts to quantities, from quantities to parameters."""
