"""Protocols that many tests begin with: a short way to a film that is near (13 mm, where it is met at 17)."""

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
