"""Traffic of cut-ins fitted to trajectories: what laws are fitted to, the laws, and what is not known of them."""
