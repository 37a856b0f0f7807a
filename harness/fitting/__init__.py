"""Trajectories: the input table, what is read from it, and the fit of each family to it."""
