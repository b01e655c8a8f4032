"""Statistics of breakdown: Weibull distributions of voltages or fields, with specimens that did not fail."""
