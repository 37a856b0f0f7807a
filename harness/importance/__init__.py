"""What maneuvers are drawn from at critical moments, and the likelihood ratios that this costs."""
