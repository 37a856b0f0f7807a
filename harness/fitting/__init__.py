"""Traffic fitted to trajectories: the input table, what laws are fitted to, the laws, and what is not known of them."""
