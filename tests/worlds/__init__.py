"""SUMO, its twin, and AVs that SUMO moves: its own models, and programs connected to it."""
