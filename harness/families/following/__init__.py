"""What families have in common in which the AV follows a vehicle from the start: see `family`."""
