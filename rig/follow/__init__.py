"""The stage in place of a spring, a mass or a second cone: it follows the bias's law around the real film."""
