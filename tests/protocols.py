"""What many tests' runs begin with: a scene whose film is near, and a protocol that goes to it."""

TO_THE_FILM = """
[[step]]
do = "home"
[[step]]
do = "zero"
duration_s = 0.5
[[step]]
do = "approach"
speed_mm_per_s = 4.0
threshold_mN = 8.0
max_travel_mm = 8.0
"""

# The film of the shipped scenes, which is met at 40 mm, and where the approach to it begins.
_NEARER = {
    "approach_from_mm = 36.0": "approach_from_mm = 3.0",
    "contact_position_mm = 40.0": "contact_position_mm = 4.0",
}
_NEAR_HOME = "\n[simulation.stage]\nstart_position_mm = 1.0\n"


def near(scene: str) -> str:
    """The text of a scene with its film so near that the way to it is short; what a test set otherwise stays."""
    for far, nearer in _NEARER.items():
        scene = scene.replace(far, nearer)
    return scene if "[simulation.stage]" in scene else scene + _NEAR_HOME
