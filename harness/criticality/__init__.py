"""How likely a surrogate is to crash, given state and maneuver: challenge tables."""
